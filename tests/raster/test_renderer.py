"""A renderer that keeps its buffers draws what a fresh one draws."""

from __future__ import annotations

import numpy as np
import pytest

from stages.raster.draw import render, renderer
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


def test_an_unknown_backend_is_named() -> None:
    with pytest.raises(ValueError, match="magic"):
        renderer(scenes.cloud(3), backend="magic")
