"""Splats that are dropped from steps."""

import numpy as np
import pytest
import torch

from stages.base.stage import Report
from stages.raster.backends import rasteriser_of
from stages.raster.definition import RasterSettings, splat_arrays
from stages.raster.draw import render
from stages.scene import DrawSettings, rgb_to_dc
from stages.train.dropout import (
    DROPOUT_BELOW,
    MAX_PROBABILITY,
    NEIGHBOURHOOD,
    Dropout,
    noise,
    uses_dropout,
)
from stages.train.loop import train as train_all
from stages.train.loss import channel_means
from stages.train.optimiser import LearningRates, new_model
from stages.train.schedule import DENSIFICATION_END, Schedule
from stages.train.steps import gpu as gpu_step
from stages.train.steps.cpu import CpuStep
from stages.train.steps.reference import ReferenceStep
from stages.train.steps.step import StepInput
from stages.train.views import Level
from tests.scenes import camera, cloud
from tests.train.pictures import trainer_of, view_of

VIEWS = 20


def shares(seen, steps=4000):
    """How often each splat is dropped, visible in so many of `VIEWS` steps."""
    seen = np.asarray(seen, np.int32)
    return np.mean([Dropout(VIEWS, key).dropped(seen) for key in range(steps)], axis=0)


def test_splats_that_few_views_see_are_dropped_often_and_others_hardly_ever():
    seen = np.repeat([0, 1, 2, 4, 8, 20], 500)
    found = shares(seen).reshape(6, 500).mean(1)
    n = VIEWS * 9 / 21  # photographs that see what 8 of 20 steps had in their picture
    few = [MAX_PROBABILITY] * 3
    wanted = [*few, 4 * (9 / 5) ** 2 / n**2, 4 / n**2, 0.01]
    np.testing.assert_allclose(found, wanted, atol=0.004)


def test_random_numbers_of_steps_and_of_neighbourhoods_are_independent():
    lots = np.array([noise(40000, key)[::NEIGHBOURHOOD] for key in range(64)]) / 2.0**32
    assert abs(lots.mean() - 0.5) < 0.005
    assert abs(np.corrcoef(lots[:32].ravel(), lots[32:].ravel())[0, 1]) < 0.01  # steps
    assert abs(np.corrcoef(lots[:, :-1].ravel(), lots[:, 1:].ravel())[0, 1]) < 0.01  # neighbours
    assert (noise(5000, 7) == noise(9000, 7)[:5000]).all()


def test_neighbourhoods_are_dropped_together():
    found = noise(4 * NEIGHBOURHOOD + 3, 7)
    whole = found[: 4 * NEIGHBOURHOOD].reshape(4, NEIGHBOURHOOD)
    assert (whole == whole[:, :1]).all()
    assert len(set(whole[:, 0])) == 4
    assert (found[-3:] == found[-1]).all()


def test_dropout_without_counts_and_without_splats():
    assert Dropout(VIEWS, 1).dropped(np.zeros(0, np.int32)).shape == (0,)
    assert shares(np.zeros(500)).mean() == pytest.approx(0.01, abs=0.002)


def test_a_device_drops_the_same_splats():
    seen = np.random.default_rng(2).integers(0, 40, 5000).astype(np.int32)
    for key in (0, 1, 0xFFFFFFFF):
        wanted = Dropout(VIEWS, key).dropped(seen)
        found = gpu_step.dropped(Dropout(VIEWS, key), torch.tensor(seen))
        np.testing.assert_array_equal(found.numpy(), wanted)
    assert len(gpu_step.dropped(Dropout(VIEWS, 1), torch.zeros(0, dtype=torch.int32))) == 0


@pytest.mark.parametrize("step_class", [CpuStep, ReferenceStep])
def test_dropped_splats_do_not_move_and_others_replace_them(step_class):
    scene = cloud(80, 40, 30, degree=0)
    where = camera(40, 30)
    pixels = np.full((3, 30, 40), 200, np.uint8)
    level = Level(where, pixels, channel_means(pixels))
    model = new_model(*splat_arrays(scene))
    model.sh[:] = rgb_to_dc(np.full(3, 0.2))
    before = model.take(np.arange(len(model)))
    step = step_class(rasteriser_of("cpu" if step_class is CpuStep else "reference"))
    step.load(model)
    dropout = Dropout(3, 5)
    dropped = dropout.dropped(model.gradient_count)
    assert 10 < dropped.sum() < 45
    step.step(StepInput(level, RasterSettings(sh_degree=0), LearningRates(1e-3), False, dropout))
    moved = (step.model().sh != before.sh).any((1, 2))
    assert not moved[dropped].any()
    assert moved[~dropped].mean() > 0.5
    np.testing.assert_array_equal(
        step.model().opacity_logits[dropped], before.opacity_logits[dropped]
    )


@pytest.mark.parametrize(
    ("views", "dropout"), [(1, True), (DROPOUT_BELOW - 1, True), (DROPOUT_BELOW, False)]
)
def test_dropout_is_for_captures_of_few_views(views, dropout):
    assert uses_dropout(views) == dropout


def test_splats_are_dropped_only_after_densification(tmp_path, monkeypatch):
    where = camera(40, 30)
    picture = np.clip(render(cloud(80, 40, 30, degree=0), where, RasterSettings()).image, 0, 1)
    start = cloud(60, 40, 30, degree=0, seed=4)
    schedule = Schedule(steps=200, extent=10.0, sh_degree=0, n_start=len(start), seed=0)
    views = [view_of(f"{k}", picture, where) for k in range(4)]
    made = trainer_of(schedule, views, [], DrawSettings(near=0.1), 200, tmp_path, Report())
    dropped, step = [], made.stepper.step

    def recording(given):
        dropped.append(given.dropout is not None)
        return step(given)

    monkeypatch.setattr(made.stepper, "step", recording)
    train_all(made, start)
    assert dropped == [k >= DENSIFICATION_END * 200 for k in range(200)]
