"""A training step on a WebGPU device, which a program on the CPU may play."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import numpy as np
import pytest

from stages.base.errors import ResourceError
from stages.raster.definition import MemoryFull, RasterSettings
from stages.raster.reference_rasteriser import ReferenceRasteriser
from stages.raster.webgpu import device
from stages.raster.webgpu.rasteriser import WebGpuRasteriser
from stages.scene import IGNORE, TRANSPARENT
from stages.train.dropout import Dropout
from stages.train.gauss_newton import GaussNewton
from stages.train.optimiser import LearningRates, Model, empty_model
from stages.train.steps.device_model import DeviceModel
from stages.train.steps.reference import ReferenceStep
from stages.train.steps.step import StepInput
from stages.train.steps.webgpu import WebGpuStep
from tests.scenes import camera
from tests.train.steps.models import (
    EVENTS,
    level,
    losses_where_masked_later,
    masked,
    start,
    used_model,
)

pytestmark = pytest.mark.skipif(bool(device.missing()), reason=device.missing())
RATES = LearningRates(means=1e-3, extent=2.0)
SETTINGS = RasterSettings(near=0.1, sh_degree=1)
FIELDS = [field.name for field in fields(Model)]


def stepper(lag: int = 0, model: Model | None = None) -> WebGpuStep:
    made = WebGpuStep(WebGpuRasteriser(), lag)
    made.load(start() if model is None else model)
    return made


@pytest.mark.parametrize("degree", [0, 1])
def test_steps_leave_what_the_definition_leaves(degree):
    settings = RasterSettings(near=0.1, sh_degree=degree)
    plain, found = ReferenceStep(ReferenceRasteriser()), stepper()
    for step in (plain, found):
        model = start()
        model.smoothing[:], model.sh_degrees[:4] = 0.02, 0
        step.load(model)
    drops, one, other = Dropout(5, 7), GaussNewton(300.0, 1), GaussNewton(300.0, 2)
    for dropout, moves in ((None, None), (drops, None), (None, one), (drops, other), (None, other)):
        given = StepInput(level(), settings, RATES, True, dropout, gauss_newton=moves)
        losses = [s.step(given) for s in (found, plain)]
        assert losses[0] == pytest.approx(losses[1], rel=1e-5)
    for name, wanted in vars(plain.model()).items():
        here = getattr(found.model(), name)
        assert here.shape == wanted.shape
        assert here.dtype == wanted.dtype
        top = max(np.abs(wanted).max(), 1e-9)
        np.testing.assert_allclose(here, wanted, atol=2e-5 * top, err_msg=name)


@pytest.mark.parametrize("seen", [masked(IGNORE, None), masked(TRANSPARENT, (0.3, -0.2, 0.1))])
def test_masks_and_light_ask_what_the_definition_asks(seen):
    settings = RasterSettings(near=0.1, sh_degree=0, background=(0.2, 0.9, 0.4))
    plain, found = ReferenceStep(ReferenceRasteriser()), stepper()
    plain.load(start())
    given = StepInput(seen, settings, RATES, weight=4.0, gauss_newton=GaussNewton(300.0, 5))
    losses = [s.step(given) for s in (found, plain)]
    assert losses[0] == pytest.approx(losses[1], rel=1e-5)
    for name in ("moment1", "moment2"):
        here, wanted = (getattr(s.model(), name) for s in (found, plain))
        assert wanted.any()
        np.testing.assert_allclose(here, wanted, atol=2e-5 * np.abs(wanted).max())


def test_two_runs_leave_the_same_bytes():
    runs = []
    for _ in range(2):
        made = stepper(lag=3)
        for seed in range(6):
            made.step(StepInput(level(seed=seed % 2), SETTINGS, RATES, False, Dropout(5, seed)))
        runs.append(made.model().on_host())
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(runs[0], name), getattr(runs[1], name))


def test_a_steady_step_never_waits_for_the_device(monkeypatch):
    made, seen = stepper(lag=3), level()
    for _ in range(5):
        made.step(StepInput(seen, SETTINGS, RATES))
    waits: list[Any] = []
    read = device.Device.read

    def counted(*given: Any) -> Any:
        waits.append(given)
        return read(*given)

    monkeypatch.setattr(device.Device, "read", counted)
    made.step(StepInput(seen, SETTINGS, RATES, False, Dropout(5, 7)))
    assert not waits
    assert np.isfinite(made.model().means).all()
    assert waits


def test_lists_without_room_leave_the_model_as_it_was_and_get_room():
    made, seen = stepper(lag=1), level()
    for _ in range(2):
        made.step(StepInput(seen, SETTINGS, RATES))
    before, made._room = made.model().on_host(), 1
    made.step(StepInput(seen, SETTINGS, RATES))
    for name, kept in vars(made.model().on_host()).items():
        np.testing.assert_array_equal(kept, getattr(before, name))
    made.step(StepInput(seen, SETTINGS, RATES))
    assert made._room > 1
    made.step(StepInput(seen, SETTINGS, RATES))
    assert made.skipped == 1
    assert (made.model().steps > before.steps).any()


@pytest.mark.parametrize("event", EVENTS)
def test_what_rules_leave_is_what_they_leave_on_the_host(event):
    made = stepper(model=used_model())
    made._on_host = None  # so that it comes from the device
    wanted, there = EVENTS[event](used_model()), EVENTS[event](made.model())
    assert isinstance(there, DeviceModel)
    made.load(there)
    for found in (there.on_host(), made.model().on_host()):
        assert len(found) == len(wanted) == len(made) != 300
        for name in FIELDS:
            here, kept = getattr(found, name), getattr(wanted, name)
            np.testing.assert_array_equal(here, kept, err_msg=name)
            assert here.dtype == kept.dtype


def test_an_empty_model_is_drawn_and_trained():
    made = stepper(model=empty_model())
    for _ in range(2):
        assert np.isfinite(made.step(StepInput(level(), SETTINGS, RATES)))
    assert not made.draw(camera(40, 30), SETTINGS, smooth=False).any()
    made.load(made.model().take(np.zeros(0, bool)).in_morton_order())
    assert len(made) == len(made.model().on_host()) == 0


@pytest.fixture
def own_device():
    """Of this test alone."""
    device.device.cache_clear()
    yield
    device.device.cache_clear()


def test_a_device_that_is_lost_is_said_to_have_stopped(own_device):
    made = stepper(lag=3)
    made.step(StepInput(level(), SETTINGS, RATES))
    made.gpu.wgpu.destroy()
    for work in (
        lambda: made.step(StepInput(level(), SETTINGS, RATES)),
        lambda: made.model().means,
    ):
        with pytest.raises(ResourceError) as caught:
            work()
        assert caught.value.code == "raster-webgpu-failed"


def test_more_than_a_buffer_holds_is_said_to_be_too_many_splats(monkeypatch):
    made = stepper()
    full = pytest.importorskip("wgpu").GPUOutOfMemoryError("Not enough memory left.")

    def refused(words: int) -> Any:
        raise full

    monkeypatch.setattr(made.gpu, "empty", refused)
    with pytest.raises(MemoryFull):
        made.load(start())


def test_a_forgotten_view_is_ignored_where_it_has_become_masked():
    found, wanted = losses_where_masked_later(stepper(), stepper())
    assert found == wanted


def test_photographs_make_room_where_memory_is_full(monkeypatch):
    made = stepper()
    refused: list[int] = []
    made.load(start())
    made.step(StepInput(level(), SETTINGS, RATES))
    run = made.gpu.run

    def short_of_memory(*given: Any) -> None:
        if not refused:
            refused.extend(made._photographs)
            raise pytest.importorskip("wgpu").GPUOutOfMemoryError("Not enough memory left.")
        run(*given)

    monkeypatch.setattr(made.gpu, "run", short_of_memory)
    made.step(StepInput(level(), SETTINGS, RATES))
    assert refused
    assert made._photographs
