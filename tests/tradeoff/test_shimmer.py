"""Shimmer of pictures with and without aliasing, and the extreme framings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stages.evaluate.evaluation import EvaluationView
from stages.raster.definition import RasterSettings
from stages.raster.draw import renderer
from stages.scene import Camera, Splats
from stages.tradeoff.shimmer import (
    at_resolution,
    from_distance,
    higher,
    shimmer,
    sideways,
    small_psnr_db,
)

DEPTH = 4.0
CAMERA = Camera(64, 48, 64.0, 64.0, 32.0, 24.0, np.eye(4))


def sheet(spacing_px: float, size_px: float) -> Splats:
    """A sheet of random colours at DEPTH, solid splats so far apart and so large."""
    pixel = DEPTH / CAMERA.fx
    x, y = np.meshgrid(*(np.arange(-half, half, spacing_px * pixel) for half in (3.0, 2.5)))
    n = x.size
    rng = np.random.default_rng(2)
    return Splats(
        means=np.stack([x.ravel(), y.ravel(), np.full(n, DEPTH)], 1).astype(np.float32),
        quaternions=np.tile(np.array([1, 0, 0, 0], np.float32), (n, 1)),
        log_scales=np.full((n, 3), np.log(size_px * pixel), np.float32),
        opacity_logits=np.full(n, 3, np.float32),
        sh=rng.uniform(-1.7, 1.7, (n, 1, 3)).astype(np.float32),
        sh_degrees=np.zeros(n, np.uint8),
    )


def drawing(splats: Splats, antialias: bool = False):
    draw = renderer(splats, RasterSettings(near=0.01, antialias=antialias), "cpu")
    return lambda camera: draw(camera).image


def test_detail_larger_than_pixels_does_not_shimmer_and_finer_detail_does() -> None:
    smooth = shimmer(drawing(sheet(8, 6)), CAMERA, DEPTH)[1]
    fine = shimmer(drawing(sheet(0.7, 0.05)), CAMERA, DEPTH)[1]
    assert smooth < 0.5
    assert fine > 5
    assert shimmer(drawing(sheet(0.7, 0.05), antialias=True), CAMERA, DEPTH)[1] < fine / 2


def test_a_linear_ramp_does_not_shimmer_however_steep() -> None:
    def draw(camera: Camera) -> np.ndarray:
        shift = camera.world_to_camera[0, 3] * camera.fx / DEPTH
        return np.repeat(((np.arange(64) + shift) / 100 + 0.1)[None, :, None], 3, axis=2)

    assert shimmer(draw, CAMERA, DEPTH)[1] == pytest.approx(0, abs=1e-9)


def test_framings_keep_the_subject_in_the_middle() -> None:
    target = np.array([[0.0, 0.0, DEPTH]])
    for moved, depth in (
        (from_distance(CAMERA, 4, DEPTH), 4 * DEPTH),
        (from_distance(CAMERA, 0.25, DEPTH), DEPTH / 4),
        (higher(CAMERA, 15, DEPTH), DEPTH),
    ):
        pixels, z = moved.project(target)
        np.testing.assert_allclose(pixels, [[32, 24]], atol=1e-9)
        assert z[0] == pytest.approx(depth)
    assert higher(CAMERA, 15, DEPTH).centre[1] == pytest.approx(-DEPTH * np.sin(np.pi / 12))
    assert sideways(CAMERA, 2, DEPTH).project(target)[0][0] == pytest.approx([30, 24])


def test_the_size_of_a_large_picture_is_limited() -> None:
    assert at_resolution(replace(CAMERA, width=6400), 4).width == 6400
    assert at_resolution(replace(CAMERA, width=1600), 4).width == 2560
    assert at_resolution(CAMERA, 0.25).width == 16


def test_fine_splats_thicken_in_small_pictures_and_not_in_pictures_scaled_down() -> None:
    splats = sheet(2, 0.3)
    draw = drawing(splats)
    pixels = (np.clip(draw(CAMERA), 0, 1) * 255 + 0.5).astype(np.uint8)
    small, scaled = small_psnr_db(draw, [EvaluationView("a", CAMERA, pixels)])
    assert scaled > 45
    assert small < scaled - 10


def test_invalid_pixels_do_not_count_in_small_pictures_either() -> None:
    draw = drawing(sheet(8, 6))
    pixels = (np.clip(draw(CAMERA), 0, 1) * 255 + 0.5).astype(np.uint8)
    saturated = np.zeros((48, 64), bool)
    saturated[:9] = True
    pixels[:9] = 255
    whole, valid = (
        small_psnr_db(draw, [EvaluationView("a", CAMERA, pixels, saturated=c)])
        for c in (None, saturated)
    )
    assert whole[1] < 20
    assert valid[1] > 45
