"""A model that stays on a device, played by the CPU: every rule leaves what it leaves on the host,
and reads small columns alone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from functools import partial

import numpy as np
import pytest
import torch

pytest.importorskip("triton")

from stages.raster.definition import RasterSettings, splat_arrays
from stages.raster.gpu.rasteriser import GpuRasteriser
from stages.scene import morton
from stages.train.cap import most_opaque
from stages.train.density import AdaptiveDensity, BoundedDensity, cull
from stages.train.free_space import known_free_space
from stages.train.loss import channel_means
from stages.train.optimiser import LearningRates, Model, empty_model, new_model
from stages.train.steps import device_model
from stages.train.steps.device_model import DeviceModel, held_of
from stages.train.steps.gpu import GpuStep
from stages.train.steps.memory_limited import MemoryLimitedStep
from stages.train.steps.step import StepInput
from stages.train.views import Level
from tests.scenes import camera, cloud

pytestmark = pytest.mark.gpu
FIELDS = [field.name for field in fields(Model)]
LARGE = ("sh", "moment1", "moment2", "steps")


def start(n: int = 300, degree: int = 1) -> Model:
    r = np.random.default_rng(5)
    found = new_model(*(a.copy() for a in splat_arrays(cloud(n, 40, 30, degree, seed=4))))
    for name in ("moment1", "moment2", "gradient_sum", "smoothing", "distances"):
        array = getattr(found, name)
        array[:] = r.random(array.shape) * 4e-3
    found.steps[:] = r.integers(0, 9, found.steps.shape)
    found.gradient_count[:] = r.integers(0, 20, n)
    found.sh_degrees[: n // 2] = 0
    found.means[3], found.sh[7, 1, 2] = np.inf, np.nan
    return found


def on_device(model: Model) -> DeviceModel:
    return DeviceModel(held_of(model, GpuRasteriser()))


def cameras(n: int = 6):
    found = []
    for k in range(n):
        pose = np.eye(4)
        pose[:3, 3] = 0.3 * k, -0.2 * k, 0.5 * k - 1.0
        found.append(camera(40, 30, matrix=pose))
    return found


def densified(rule, model: Model) -> Model:
    return rule.grow(cull(model), 340).in_morton_order()


def floaters_removed(space, model: Model) -> Model:
    return model.take(~model.in_free_space(space))


ADAPTIVE = AdaptiveDensity(12)
EVENTS: dict[str, Callable[[Model], Model]] = {
    "densification": partial(densified, ADAPTIVE),
    "in a part": partial(densified, BoundedDensity(ADAPTIVE, (-1.0, 0.0, 1.0, 4.0))),
    "floaters": partial(
        floaters_removed, known_free_space(3 * cloud(300, 40, 30, seed=9).means, cameras(3))
    ),
    "fewest": partial(most_opaque, cap=100),
    "twice": lambda model: densified(ADAPTIVE, densified(ADAPTIVE, model)),
}


@pytest.mark.parametrize("event", EVENTS)
def test_what_rules_leave_is_what_they_leave_on_the_host(event):
    wanted, there = EVENTS[event](start()), EVENTS[event](on_device(start()))
    assert isinstance(there, DeviceModel)
    read = set(vars(there)) & set(FIELDS)
    assert not read & set(LARGE)
    found = DeviceModel(there.gathered()).on_host()
    assert len(found) == len(there) == len(wanted) != 300
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(found, name), getattr(wanted, name), err_msg=name)
        assert getattr(found, name).dtype == getattr(wanted, name).dtype


def test_what_depends_on_cameras_is_what_the_host_computes():
    model = start()
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
    there = on_device(start())
    with pytest.raises(ValueError, match="read-only"):
        there.means[0] = 1.0
    with pytest.raises(AttributeError):
        _ = there.colour
    there.distances = np.full(300, 3.0, np.float32)
    assert (there.distances == 3.0).all()
    assert (there.take(np.arange(5)).on_host().distances == 3.0).all()


def stepped() -> GpuStep:
    made = GpuStep(GpuRasteriser())
    made.load(start(20))
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
