"""Splats for plain drawing, made from splats for drawing with opacity compensation."""

from __future__ import annotations

import numpy as np
import pytest

from stages.raster.compensation import mean_compensation, without_compensation
from stages.raster.draw import render
from tests.scenes import camera, cloud, splats
from tests.tolerances import FLOAT32_IMAGE


def distant(z: float):
    matrix = np.eye(4)
    matrix[2, 3] = z
    return camera(matrix=matrix)


def test_draw_settings_decide_how_splats_are_drawn():
    small = splats([[0, 0, 2.0]], scales=0.005, opacities=0.9)
    plain, compensated = render(small, camera()), render(small.with_antialias(True), camera())
    assert compensated.alpha.max() < 0.3 * plain.alpha.max()


def test_seen_by_one_camera_the_picture_stays_the_same():
    scene = cloud(200, size_px=0.7).with_antialias(True)
    plain = without_compensation(scene, [camera()])
    assert not plain.draw_settings.antialias
    kept = render(scene, camera()).image, render(plain, camera()).image
    assert np.abs(kept[0] - kept[1]).max() < FLOAT32_IMAGE


def test_the_factor_is_the_mean_over_the_cameras_that_see_the_splat():
    scene = splats([[0, 0, 2.0], [0, 0, -50.0]], scales=0.02, opacities=0.9)
    near, far = (mean_compensation(scene, [distant(z)])[0] for z in (0.0, 4.0))
    assert far < 0.5 * near
    both = mean_compensation(scene, [distant(0.0), distant(4.0)])
    assert both == pytest.approx([(near + far) / 2, 1.0])


def test_large_splats_keep_their_opacity():
    scene = splats([[0, 0, 2.0]], scales=0.5, opacities=0.9)
    assert mean_compensation(scene, [camera()])[0] > 0.99
