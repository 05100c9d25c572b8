"""One list of backends: what it names runs, is chosen by name, and is held to the definition."""

from __future__ import annotations

import sys
from types import SimpleNamespace

import numpy as np
import pytest

from stages.raster import backends
from stages.raster.backends import AUTO, Backend
from stages.raster.definition import Backward
from stages.raster.gpu import device as gpu
from stages.raster.reference_rasteriser import ReferenceRasteriser
from stages.raster.webgpu import device as webgpu
from tests.scenes import BACKENDS, camera, cloud, exact_gradients, gradients, relative
from tests.tolerances import FLOAT32_GRADIENT


class Zeros(ReferenceRasteriser):
    """Draws, and says that nothing matters."""

    def backward(self, forward, v_image):
        found = super().backward(forward, v_image)
        none = np.zeros_like(found.parameters)
        return Backward(found.rows, none, np.zeros_like(found.means2d))


def worst_gradient(backend: str) -> float:
    scene, view = cloud(40, degree=1), camera()
    v = np.random.default_rng(2).normal(size=(48, 64, 3))
    found, wanted = gradients(backend, scene, view, v), exact_gradients(scene, view, v)
    return max(relative(found[name], wanted[name]) for name in wanted)


@pytest.mark.parametrize("name", BACKENDS)
def test_every_backend_in_the_list_has_the_gradients_of_the_definition(name: str) -> None:
    assert worst_gradient(name) <= FLOAT32_GRADIENT


def test_a_backend_that_returns_zeros_is_found_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """It would pass a test that ran other kernels in its place."""
    fake = Backend("zeros", Zeros, "for this test")
    monkeypatch.setattr(backends, "BACKENDS", (*backends.BACKENDS, fake))
    assert worst_gradient("zeros") > 0.5


def test_a_backend_takes_part_in_training_without_a_step_of_its_own(monkeypatch) -> None:
    from stages.raster.reference_rasteriser import ReferenceRasteriser
    from stages.train.steps.reference import ReferenceStep
    from stages.train.steps.step import step_of

    fake = Backend("another", ReferenceRasteriser, "a test")
    monkeypatch.setattr(backends, "BACKENDS", (*backends.BACKENDS, fake))
    assert isinstance(step_of("another"), ReferenceStep)


def test_an_unknown_backend_is_named_with_those_that_there_are() -> None:
    wanted = "'magic', wanted one of auto, gpu, webgpu, cpu, reference"
    with pytest.raises(ValueError, match=wanted):
        backends.rasteriser_of("magic")


@pytest.mark.parametrize(
    ("kind", "fault", "chosen"),
    [("IntegratedGPU", "", "webgpu"), ("CPU", "", "cpu"), ("DiscreteGPU", "no adapter", "cpu")],
)
def test_auto_takes_webgpu_on_hardware_alone(kind, fault, chosen, monkeypatch) -> None:
    """An adapter that is a program on the CPU is slower than the kernels for the CPU."""
    info = {"adapter_type": kind, "device": "this one"}
    monkeypatch.setattr(gpu, "missing", lambda: "no card")
    monkeypatch.setattr(webgpu, "missing", lambda: fault)
    monkeypatch.setattr(webgpu, "_may_have_card", lambda: True)
    monkeypatch.setattr(webgpu, "_adapter", lambda: SimpleNamespace(info=info))
    assert backends.backend_of(AUTO).name == chosen
    assert ("this one" in backends.unavailable_backends(AUTO).get("webgpu", "")) == (kind == "CPU")


def test_auto_looks_for_no_adapter_where_linux_shows_no_card(monkeypatch) -> None:
    """It would take a second of every command."""
    looked: list[str] = []
    monkeypatch.setattr(gpu, "missing", lambda: "no card")
    monkeypatch.setattr(webgpu, "wgpu", SimpleNamespace())
    monkeypatch.setattr(webgpu, "_CARDS", ("no/such/card*",))
    monkeypatch.setattr(webgpu, "_adapter", lambda: looked.append("an adapter"))
    monkeypatch.setattr(sys, "platform", "linux")
    assert backends.backend_of(AUTO).name == "cpu"
    assert "no/such/card*" in backends.unavailable_backends(AUTO)["webgpu"]
    assert not looked
