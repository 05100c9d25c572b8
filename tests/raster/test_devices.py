"""The reference on any device of torch: in blocks that bound its memory, wholly on the device."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch.overrides import TorchFunctionMode

from stages.base.errors import SplatError
from stages.base.stage import Report
from stages.raster import reference, torch_device
from stages.raster.backends import backend_of, qualified_name, rasteriser_of, report_backend
from stages.raster.definition import RasterSettings, splat_arrays
from stages.raster.reference_rasteriser import ReferenceRasteriser
from tests.scenes import PARAMETERS, camera, cloud, exact_gradients, gradients, relative
from tests.tolerances import FLOAT32_OUTPUT

SETTINGS = RasterSettings(background=(0.2, 0.4, 0.1), antialias=True)
MAKERS = {torch.tensor, torch.zeros, torch.ones, torch.empty, torch.arange, torch.full}


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


class Noting(TorchFunctionMode):
    """Which device each new tensor is asked for."""

    def __init__(self) -> None:
        super().__init__()
        self.asked: list[Any] = []

    def __torch_function__(self, func, types, args=(), kwargs=None):
        if func in MAKERS:
            self.asked.append((kwargs or {}).get("device"))
        return func(*args, **(kwargs or {}))


def test_every_tensor_is_made_on_the_device_that_was_asked_for() -> None:
    scene, view = cloud(40, 40, 30, degree=1), camera(40, 30)
    with Noting() as noting:
        drawn(scene, view)
    assert len(noting.asked) > 20
    assert set(noting.asked) == {torch.device("cpu")}


def test_a_device_without_float64_draws_in_float32(monkeypatch: pytest.MonkeyPatch) -> None:
    scene, view = cloud(60, 40, 30, degree=1), camera(40, 30)
    wanted = drawn(scene, view)
    monkeypatch.setattr("stages.raster.reference_rasteriser.widest", lambda device: torch.float32)
    for here, there in zip(drawn(scene, view), wanted, strict=True):
        assert np.isfinite(here).all()
        assert relative(here, there) < 1e-3


def test_float64_is_given_up_where_the_device_refuses_it(monkeypatch: pytest.MonkeyPatch) -> None:
    assert torch_device.widest("cpu") == torch.float64

    def refused(*args, **kwargs):
        raise TypeError("Cannot convert a MPS Tensor to float64 dtype")

    monkeypatch.setattr(torch, "ones", refused)
    assert torch_device.widest("mps") == torch.float32


@pytest.mark.parametrize("name", ["cuda", "mps", "xpu"])
def test_a_device_that_is_not_there_is_named_with_those_that_are(name, monkeypatch) -> None:
    monkeypatch.setattr(torch_device, "is_there", lambda asked: asked == "cpu")
    with pytest.raises(SplatError, match=f"--device {name}") as caught:
        rasteriser_of(qualified_name("reference", name))
    assert caught.value.code == "raster-no-device"
    assert caught.value.wanted == "A device that is available: cpu."


def test_only_a_backend_that_takes_devices_is_given_one() -> None:
    assert qualified_name("gpu", "cpu") == "gpu"
    assert qualified_name("reference", "mps") == "reference@mps"
    with pytest.raises(SplatError, match="--backend reference") as caught:
        qualified_name("auto", "cuda")
    assert caught.value.code == "option-device"
    with pytest.raises(ValueError, match="cpu@cuda"):
        backend_of("cpu@cuda")


def test_a_manifest_says_what_a_stage_drew_on(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch_device, "is_there", lambda name: True)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda: "Some Card")
    report = Report()
    report_backend(report, "reference@cuda")
    assert report.metrics["backend"] == "reference"
    assert report.device.startswith("Some Card, torch ")
