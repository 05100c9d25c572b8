"""A renderer that keeps its buffers draws what a fresh one draws."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stages.raster.definition import Rendering
from stages.raster.draw import render, renderer, supersampled
from stages.scene import Camera
from stages.scene.draw_settings import DrawSettings
from tests import scenes


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_frames_do_not_disturb_each_other(backend: str) -> None:
    splats = scenes.cloud(60)
    cameras = [scenes.camera(), scenes.camera().resized(23, 31), scenes.camera().resized(70, 9)]
    draw = renderer(splats, backend=backend)
    frames = [draw(camera) for camera in cameras]
    for camera, frame in zip(cameras, frames, strict=True):
        alone = render(splats, camera, backend=backend)
        for name in ("image", "alpha", "depth", "median_depth"):
            np.testing.assert_array_equal(getattr(frame, name), getattr(alone, name))


def test_a_picture_of_one_pixel_outlives_the_next() -> None:
    red = scenes.splats([[0, 0, 3.0]], scales=1.0, opacities=0.9, rgb=(1.0, 0.0, 0.0))
    draw = renderer(red, backend="cpu")
    first = draw(scenes.camera(1, 1)).image
    before = first.copy()
    draw(scenes.camera(1, 1).resized(1, 1).moved(np.diag([1.0, -1.0, -1.0, 1.0])))
    np.testing.assert_array_equal(first, before)


_TWO_THREADS = """
import sys, threading
import numpy as np
from stages.raster.draw import render
from tests import scenes
clouds = [scenes.cloud(2000, seed=seed) for seed in (1, 2)]
camera = scenes.camera(320, 240)
wanted = [render(cloud, camera, backend="cpu").image for cloud in clouds]
right = []
def draw(which):
    for _ in range(20):
        image = render(clouds[which], camera, backend="cpu").image
        right.append(np.array_equal(image, wanted[which]))
threads = [threading.Thread(target=draw, args=(i,)) for i in (0, 1)]
for thread in threads: thread.start()
for thread in threads: thread.join()
sys.exit(0 if len(right) == 40 and all(right) else 1)
"""


def test_threads_draw_at_the_same_time() -> None:
    """In a process of its own: what they disturb of each other may end it."""
    words = [sys.executable, "-c", _TWO_THREADS]
    paths = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
    assert subprocess.run(words, env=paths, check=False, timeout=300).returncode == 0


def test_an_unknown_backend_is_named() -> None:
    with pytest.raises(ValueError, match="magic"):
        renderer(scenes.cloud(3), backend="magic")


def test_a_small_picture_is_the_mean_of_one_as_large_as_those_of_training() -> None:
    """A wall of splats of a fifth of a pixel, which is dense in the larger picture."""
    x, y = np.meshgrid(np.linspace(-2, 2, 40), np.linspace(-2, 2, 40))
    wall = np.stack([x, y, np.full_like(x, 3.0)], -1).reshape(-1, 3)
    scene = replace(
        scenes.splats(wall, scales=0.08, opacities=0.95, rgb=(1.0, 1.0, 1.0)),
        draw_settings=DrawSettings(antialias=True),
    )
    small = scenes.camera(8, 6, focal=7.5)
    draw = renderer(scene, backend="cpu")
    found, large = supersampled(draw, 64)(small), draw(small.resized(64, 48))
    wanted = large.image.reshape(6, 8, 8, 8, 3).mean((1, 3))
    np.testing.assert_allclose(found.image, wanted, atol=1e-6)
    assert found.median_depth.shape == found.alpha.shape == (6, 8)
    assert found.alpha.min() > 0.99 > draw(small).alpha.max()
    assert supersampled(draw, 8)(small).image.tolist() == draw(small).image.tolist()


@pytest.mark.parametrize(("side", "times"), [(0, 1), (9, 1), (11, 1), (12, 2), (19, 2), (21, 3)])
def test_a_small_picture_is_drawn_at_the_multiple_nearest_to_training(
    side: int, times: int
) -> None:
    """Of 8 pixels. Larger than in training splats are narrower than they were trained to be."""
    drawn = []

    def draw(camera: Camera) -> Rendering:
        drawn.append(camera.width)
        alpha, depth, median = np.zeros((3, camera.height, camera.width), np.float32)
        return Rendering(np.stack([alpha] * 3, -1), alpha, depth, median, 0)

    assert supersampled(draw, side)(scenes.camera(8, 6, focal=7.5)).image.shape == (6, 8, 3)
    assert drawn == [8 * times]
