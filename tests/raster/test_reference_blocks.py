"""The reference draws in blocks that bound its memory."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from stages.raster import reference
from stages.raster.definition import RasterSettings, splat_arrays
from stages.raster.reference_rasteriser import ReferenceRasteriser
from tests.scenes import PARAMETERS, camera, cloud, exact_gradients, gradients, relative
from tests.tolerances import FLOAT32_OUTPUT

SETTINGS = RasterSettings(background=(0.2, 0.4, 0.1), antialias=True)


def drawn(scene, view) -> list[np.ndarray]:
    """Picture, gradients, contributions of the reference as a backend."""
    rasteriser, arrays = ReferenceRasteriser(), splat_arrays(scene)
    v = np.random.default_rng(1).normal(size=(3, view.height, view.width)).astype(np.float32)
    forward = rasteriser.forward(arrays, view, SETTINGS, depths=True)
    backward = rasteriser.backward(forward, v)
    found = rasteriser.contributions(forward, v)
    return [forward.image, backward.parameters, backward.means2d, found]


@pytest.mark.parametrize("most", [1, 5000])
def test_smaller_pieces_change_nothing(most: int, monkeypatch: pytest.MonkeyPatch) -> None:
    scene, view = cloud(120, 70, 40, degree=2), camera(70, 40)
    wanted = drawn(scene, view)
    monkeypatch.setattr(reference, "MOST", most)
    for here, there in zip(drawn(scene, view), wanted, strict=True):
        assert relative(here, there) <= FLOAT32_OUTPUT


def test_block_by_block_is_autograd_through_the_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    scene, view = cloud(80, 70, 40, degree=1), camera(70, 40)
    v = np.random.default_rng(1).normal(size=(40, 70, 3))
    wanted = exact_gradients(scene, view, v, SETTINGS)
    monkeypatch.setattr(reference, "MOST", 5000)
    found = gradients("reference", scene, view, v, SETTINGS)
    for name in PARAMETERS:
        assert relative(found[name], wanted[name]) <= FLOAT32_OUTPUT, name


def test_a_crowd_of_splats_is_drawn_a_few_lines_at_a_time() -> None:
    scene, view = cloud(20_000, 32, 32, degree=0, size_px=20.0), camera(32, 32)
    with torch.no_grad():
        projected = reference.project(reference.parameters_of(scene), view, SETTINGS)
    pieces = list(reference.picture_blocks(projected, view))
    assert len(pieces) > 1
    assert sum(len(pixels) for _, _, pixels in pieces) == 32 * 32
    assert max(len(rows) * len(pixels) for _, rows, pixels in pieces) <= reference.MOST
