"""A training step on the GPU (or interpreted): what it leaves, and that it does not wait."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

pytest.importorskip("triton")

from stages.raster.definition import MemoryFull, RasterSettings
from stages.raster.gpu import device
from stages.raster.gpu.rasteriser import GpuRasteriser
from stages.raster.reference_rasteriser import ReferenceRasteriser
from stages.scene import IGNORE, TRANSPARENT
from stages.train.dropout import Dropout
from stages.train.gauss_newton import GaussNewton
from stages.train.optimiser import LearningRates, empty_model
from stages.train.steps import gpu as gpu_step
from stages.train.steps.gpu import GpuStep, image_loss
from stages.train.steps.reference import ReferenceStep, reference_loss
from stages.train.steps.step import StepInput
from tests.scenes import camera
from tests.tolerances import LOSS_GRADIENT
from tests.train.steps.models import level, losses_where_masked_later, masked, start

pytestmark = pytest.mark.gpu
RATES = LearningRates(means=1e-3)
SETTINGS = RasterSettings(near=0.1, sh_degree=1)
WAITS = ("item", "cpu", "numpy", "tolist", "nonzero", "__bool__", "__int__", "__float__")


def stepper(lag: int | None = None) -> GpuStep:
    made = GpuStep(GpuRasteriser(), lag)
    made.load(start())
    return made


@pytest.mark.slow
@pytest.mark.parametrize("degree", [0, 1])
def test_steps_leave_what_the_definition_leaves(degree):
    settings = RasterSettings(near=0.1, sh_degree=degree)
    plain = ReferenceStep(ReferenceRasteriser())
    plain.load(start())
    found = stepper()
    for moves in (None, None, GaussNewton(300.0, 1), GaussNewton(300.0, 2), GaussNewton(300.0)):
        given = StepInput(level(), settings, RATES, gauss_newton=moves)
        losses = [s.step(given) for s in (found, plain)]
        assert losses[0] == pytest.approx(losses[1], rel=1e-5)
    for name, wanted in vars(plain.model()).items():
        here = getattr(found.model(), name)
        assert here.shape == wanted.shape
        assert here.dtype == wanted.dtype
        np.testing.assert_allclose(here, wanted, atol=2e-5 * max(np.abs(wanted).max(), 1e-9))


@pytest.mark.parametrize(
    ("outside", "light"),
    [(IGNORE, None), (TRANSPARENT, (0.3, -0.2, 0.1)), (IGNORE, (0.3, -0.2, 0.1))],
)
def test_masks_and_light_ask_what_the_definition_asks(outside, light):
    settings = RasterSettings(near=0.1, sh_degree=0, background=(0.2, 0.9, 0.4))
    plain, found = ReferenceStep(ReferenceRasteriser()), stepper()
    plain.load(start())
    photograph = masked(outside, light)
    given = StepInput(photograph, settings, RATES, weight=4.0, gauss_newton=GaussNewton(300.0, 5))
    losses = [s.step(given) for s in (found, plain)]
    assert losses[0] == pytest.approx(losses[1], rel=1e-5)
    for name in ("moment1", "moment2"):
        here, wanted = (getattr(s.model(), name) for s in (found, plain))
        assert wanted.any()
        np.testing.assert_allclose(here, wanted, atol=2e-5 * np.abs(wanted).max())


@pytest.mark.parametrize("size", [(1, 1), (17, 3), (47, 33)])
def test_the_loss_and_its_gradient_are_those_of_the_definition(size):
    photograph = level(size)
    image = np.random.default_rng(1).random((4, size[1], size[0])).astype(np.float32)
    target, means = torch.from_numpy(photograph.pixels), torch.from_numpy(photograph.means)
    where = GpuRasteriser().device
    drawn = torch.from_numpy(image).to(where)
    found, gradient = image_loss(drawn, target.to(where), means.to(where))
    exact = torch.tensor(image[:3], dtype=torch.float64, requires_grad=True)
    wanted = reference_loss(exact, target.double() / 255)
    torch.autograd.backward(size[0] * size[1] * wanted)
    assert exact.grad is not None
    assert float(found) == pytest.approx(float(wanted.detach()), abs=1e-6)
    top = float(exact.grad.abs().max())
    apart = float((gradient.cpu() - exact.grad).abs().max())
    assert apart <= LOSS_GRADIENT * top


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seen", "dropout"),
    [(level(), None), (masked(TRANSPARENT, (0.3, -0.2, 0.1)), Dropout(5, 7))],
    ids=["plain", "cut out, in its light, some splats sitting out"],
)
def test_a_steady_step_never_waits_for_the_device(seen, dropout, monkeypatch):
    made = stepper(lag=2)
    given = StepInput(seen, SETTINGS, RATES, False, dropout, gauss_newton=GaussNewton(300.0, 3))
    for _ in range(4):
        made.step(given)
    waits: Counter[str] = Counter()

    def counting(name, kept):
        def counted(self, *args, **kwargs):
            waits[name] += 1
            return kept(self, *args, **kwargs)

        return counted

    for name in WAITS:
        monkeypatch.setattr(torch.Tensor, name, counting(name, getattr(torch.Tensor, name)))
    if made.device.type == "cuda":
        torch.cuda.set_sync_debug_mode("error")
    try:
        made.step(given)
    finally:
        if made.device.type == "cuda":
            torch.cuda.set_sync_debug_mode("default")
    assert not waits
    made.model().on_host()
    assert waits["cpu"] > 0  # the counter counts


@pytest.mark.skipif(not device.interpreted(), reason="a device refuses other numbers itself")
def test_kernels_are_given_plain_numbers_and_aligned_tensors(monkeypatch):
    """A device takes no NumPy numbers, and a tensor at an odd address would compile a kernel anew,
    but for `move_kernel`'s `total`."""
    import triton.language as tl
    from triton.runtime.interpreter import GridExecutor

    made, execute, seen = stepper(), GridExecutor.__call__, set()

    def checked(self, *given, **named):
        seen.add(self.fn.__name__)
        for name, value in (*zip(self.arg_names, given, strict=False), *named.items()):
            if isinstance(value, torch.Tensor):
                assert name == "total" or value.data_ptr() % 16 == 0, (self.fn.__name__, name)
            else:
                allowed = (int, float, bool, tl.dtype)
                assert type(value) in allowed, (self.fn.__name__, name, type(value))
        return execute(self, *given, **named)

    monkeypatch.setattr(GridExecutor, "__call__", checked)
    background: Any = (np.float32(0.5), 0, np.float64(1.0))
    settings = replace(SETTINGS, background=background)
    for photograph in (level(), masked(TRANSPARENT, (0.3, -0.2, 0.1))):
        made.step(StepInput(photograph, settings, RATES, smooth=True, dropout=Dropout(5, 7)))
    rasteriser, arrays = made.rasteriser, made.model().arrays
    forward = rasteriser.forward(arrays, camera(40, 30), settings, depths=True)
    rasteriser.contributions(forward, np.zeros((3, 30, 40), np.float32))
    assert len(seen) == 16


@pytest.mark.slow
def test_a_photograph_that_is_read_anew_is_sent_once(monkeypatch):
    made, seen = stepper(), level()
    made.step(StepInput(seen, SETTINGS, RATES))
    sent = []
    monkeypatch.setattr(gpu_step, "gpu_target_of", lambda *given: sent.append(given))
    again = replace(seen, pixels=seen.pixels.copy())
    made.step(StepInput(again, SETTINGS, RATES))
    assert not sent


@pytest.mark.slow
def test_lists_without_room_leave_the_model_as_it_was_and_get_room():
    made, seen = stepper(lag=1), level()
    for _ in range(2):
        made.step(StepInput(seen, SETTINGS, RATES))
    before, made._room = made.model().on_host(), 1
    made.step(
        StepInput(seen, SETTINGS, RATES, smooth=False)
    )  # has no room, which arrives one step later
    for name, kept in vars(made.model().on_host()).items():
        np.testing.assert_array_equal(kept, getattr(before, name))
    made.step(StepInput(seen, SETTINGS, RATES))
    assert int(made.skipped) == 1
    assert made._room > 1
    made.step(StepInput(seen, SETTINGS, RATES))
    assert (made.model().steps > before.steps).any()


@pytest.mark.slow
def test_lists_keep_their_room_while_the_model_is_away():
    """Rounds of removal load an empty model for a moment, because a device may not hold two."""
    made, seen = stepper(), level()
    made.step(StepInput(seen, SETTINGS, RATES))
    room, model = made._room, made.model().on_host()
    made.load(empty_model())
    made.load(model)
    assert made._room == room > 0
    made.step(StepInput(seen, SETTINGS, RATES))
    assert int(made.skipped) == 0


def full(*given):
    raise torch.OutOfMemoryError("CUDA out of memory")


@pytest.mark.slow
def test_a_full_device_loses_photographs_and_not_splats(monkeypatch):
    """A device with room for two photographs, and four of them."""
    photographs, send = [level(seed=seed) for seed in range(4)], gpu_step.gpu_target_of
    order = [photographs[number] for number in (0, 1, 2, 3, 0)]
    other, made = stepper(), stepper()
    wanted = [other.step(StepInput(seen, SETTINGS, RATES)) for seen in order]
    small = lambda *given: full() if len(made._targets) == 2 else send(*given)  # noqa: E731
    monkeypatch.setattr(gpu_step, "gpu_target_of", small)
    assert [made.step(StepInput(seen, SETTINGS, RATES)) for seen in order] == wanted
    assert len(made) == 20


@pytest.mark.slow
def test_a_forgotten_view_is_ignored_where_it_has_become_masked():
    found, wanted = losses_where_masked_later(stepper(), stepper())
    assert found == wanted


@pytest.mark.slow
def test_a_picture_that_does_not_fit_is_said_to_be_too_many_splats(monkeypatch):
    made = stepper()
    monkeypatch.setattr(made.rasteriser, "draw", full)
    with pytest.raises(MemoryFull):
        made.draw(camera(40, 30), SETTINGS, smooth=False)


@pytest.mark.slow
def test_a_model_moves_between_backends_whole():
    """As a checkpoint of one backend that another goes on with."""
    made = stepper()
    made.step(StepInput(level(), SETTINGS, RATES))
    model = made.model().on_host()
    other = GpuStep(GpuRasteriser())
    other.load(model)
    other._on_host = None  # so that it comes from the device
    for name, kept in vars(model).items():
        np.testing.assert_array_equal(getattr(other.model(), name), kept)
    plain = ReferenceStep(ReferenceRasteriser())
    plain.load(other.model().on_host())
    losses = [s.step(StepInput(level(), SETTINGS, RATES)) for s in (made, plain)]
    assert losses[0] == pytest.approx(losses[1], rel=1e-5)
