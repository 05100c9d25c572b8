"""Memory of the lists of intersections is checked before it is taken."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stages.base.errors import SplatError
from stages.raster.cpu import rasteriser
from stages.raster.draw import renderer
from stages.scene import Splats
from tests.scenes import camera, cloud

VIEW = camera(960, 720, focal=900.0)
COUNT = 3000  # each in all 2,700 tiles: 46 MiB to find them, 77 MiB of lists


def filling(log_scale: float) -> Splats:
    scene = cloud(COUNT)
    return replace(scene, log_scales=np.full_like(scene.log_scales, log_scale))


@pytest.mark.parametrize("free_mib", [10.0, 60.0])
@pytest.mark.parametrize("linear", [True, False])
def test_lists_larger_than_free_memory_are_refused_before_they_are_allocated(
    monkeypatch: pytest.MonkeyPatch, linear: bool, free_mib: float
) -> None:
    scene = filling(2.0)
    scene.log_scales[::3, 2] = 0.01 if linear else -0.01
    monkeypatch.setattr(rasteriser, "available_mib", lambda: free_mib)
    with pytest.raises(SplatError) as caught:
        renderer(scene, backend="cpu")(VIEW)
    assert caught.value.code == "raster-memory"
    assert ("linear" in caught.value.given) == linear
    assert "logarithm" in caught.value.hint if linear else "--width" in caught.value.hint


def test_lists_that_are_there_already_need_no_free_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    draw = renderer(filling(0.5), backend="cpu")
    first = draw(VIEW).image
    monkeypatch.setattr(rasteriser, "available_mib", lambda: 1.0)
    np.testing.assert_array_equal(draw(VIEW).image, first)
