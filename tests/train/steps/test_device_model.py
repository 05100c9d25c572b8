"""A model that stays on a device, played by the CPU: every rule leaves what it leaves on the host,
and reads small columns alone."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest
import torch

pytest.importorskip("triton")

from stages.raster.definition import RasterSettings
from stages.raster.gpu.rasteriser import GpuRasteriser
from stages.scene import morton
from stages.train.cap import most_opaque
from stages.train.free_space import known_free_space
from stages.train.loss import channel_means
from stages.train.optimiser import LearningRates, Model, empty_model
from stages.train.steps import device_model
from stages.train.steps.device_model import DeviceModel, held_of
from stages.train.steps.gpu import GpuStep
from stages.train.steps.memory_limited import MemoryLimitedStep
from stages.train.steps.step import StepInput
from stages.train.views import Level
from tests.scenes import camera
from tests.train.steps.models import EVENTS, cameras, used_model

pytestmark = pytest.mark.gpu
FIELDS = [field.name for field in fields(Model)]
LARGE = ("sh", "moment1", "moment2", "steps")


def on_device(model: Model) -> DeviceModel:
    return DeviceModel(held_of(model, GpuRasteriser()))


@pytest.mark.parametrize("event", EVENTS)
def test_what_rules_leave_is_what_they_leave_on_the_host(event):
    wanted, there = EVENTS[event](used_model()), EVENTS[event](on_device(used_model()))
    assert isinstance(there, DeviceModel)
    read = set(vars(there)) & set(FIELDS)
    assert not read & set(LARGE)
    found = DeviceModel(there.gathered()).on_host()
    assert len(found) == len(there) == len(wanted) != 300
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(found, name), getattr(wanted, name), err_msg=name)
        assert getattr(found, name).dtype == getattr(wanted, name).dtype


def test_what_depends_on_cameras_is_what_the_host_computes():
    model = used_model()
    there, views = on_device(model), cameras()
    np.testing.assert_allclose(
        there.camera_distances(views, 2.0).numpy(), model.camera_distances(views, 2.0), rtol=1e-6
    )
    assert (there.camera_distances([], 2.0) == 1).all()
    np.testing.assert_allclose(
        there.smoothing_widths(views, 0.1).numpy(), model.smoothing_widths(views, 0.1), rtol=1e-6
    )
    assert not there.smoothing_widths([], 0.1).any()
    space = known_free_space(model.means, views)
    np.testing.assert_array_equal(there.in_free_space(space), model.in_free_space(space))


def test_morton_order_is_the_same():
    means = np.random.default_rng(0).normal(size=(5000, 3)).astype(np.float32)
    means[100:200] = means[:100]
    means[300:400, 1] = 0.0
    found = device_model.morton_order(torch.tensor(means)).numpy()
    np.testing.assert_array_equal(found, morton.morton_order_of(means))


def test_columns_are_copies_that_cannot_be_written_to():
    there = on_device(used_model())
    with pytest.raises(ValueError, match="read-only"):
        there.means[0] = 1.0
    with pytest.raises(AttributeError):
        _ = there.colour
    there.distances = np.full(300, 3.0, np.float32)
    assert (there.distances == 3.0).all()
    assert (there.take(np.arange(5)).on_host().distances == 3.0).all()


def stepped() -> GpuStep:
    made = GpuStep(GpuRasteriser())
    made.load(used_model(20))
    pixels = np.full((3, 30, 40), 128, np.uint8)
    level = Level(camera(40, 30), pixels, channel_means(pixels))
    made.step(StepInput(level, RasterSettings(near=0.1), LearningRates()))
    return made


def test_rows_that_do_not_fit_beside_their_copies_go_through_the_host(monkeypatch):
    made = stepped()
    made._targets.clear()
    rows = np.arange(3, 15)
    wanted = made.model().on_host().take(rows)

    def full(self):
        raise torch.OutOfMemoryError("CUDA out of memory")

    taken = made.model().take(rows)
    monkeypatch.setattr(DeviceModel, "gathered", full)
    made.load(taken)
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(made.model(), name), getattr(wanted, name))


def test_a_device_that_holds_fewer_gets_the_most_opaque(monkeypatch):
    made = stepped()
    limits: list[int] = []
    limited = MemoryLimitedStep(made, limits.append)
    send = made.rasteriser.scene

    def tight(arrays):
        if len(arrays[0]) > 8:
            raise torch.OutOfMemoryError("CUDA out of memory")
        return send(arrays)

    monkeypatch.setattr(made.rasteriser, "scene", tight)
    wanted = most_opaque(made.model().on_host(), 10)
    limited.load(made.model().on_host())
    assert limits == [10, 5]
    assert len(limited) == 5
    np.testing.assert_array_equal(limited.model().means, most_opaque(wanted, 5).means)


def test_an_empty_model_has_no_rows():
    there = on_device(empty_model())
    assert len(there.take(np.zeros(0, bool)).in_morton_order().on_host()) == 0
