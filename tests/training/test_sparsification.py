"""Splats that contribute least are removed while training goes on."""

import numpy as np
import pytest

from stages.base.stage import Report
from stages.raster.definition import RasterSettings
from stages.raster.draw import render
from stages.scene import DrawSettings
from stages.training.conversion import model_of
from stages.training.density import AdaptiveDensity, BoundedDensity
from stages.training.schedule import DENSIFICATION_END, Schedule
from stages.training.sparsification import SHARES, Sparsification
from stages.training.trainer import Trainer
from tests.scenes import camera, cloud
from tests.training.pictures import view_of

STEPS = 300
WHERE = camera(40, 30)


def trainer(folder, start, within=()):
    """A run on the picture of `start` that does not densify."""
    picture = np.clip(render(start, WHERE, RasterSettings()).image, 0, 1)
    schedule = Schedule(steps=STEPS, extent=10.0, sh_degree=0, n_start=len(start), seed=0)
    views = [view_of(f"{k}", picture, WHERE) for k in range(3)]
    draw = DrawSettings(near=0.1)
    return Trainer(
        *(schedule, views, [], draw, len(start), folder, Report()), backend="cpu", within=within
    )


def sparser(made, start, share, density):
    """The model after the step that reaches this share of the run."""
    made.stepper.load(model_of(start))
    Sparsification(start, density).after_step(made, round(share * STEPS))
    return made.model


def test_a_third_of_the_splats_is_gone_at_the_end_and_none_before_densification_ends(tmp_path):
    start = cloud(400, 40, 30, degree=0)
    counts = {}
    made = trainer(tmp_path, start)
    made.report.listener = lambda label, done, total, numbers: counts.update(
        {done: numbers["splats"]} if label == "training" else {}
    )
    end = made.run(start)
    half = int(DENSIFICATION_END * STEPS)
    assert len(end) == counts[STEPS]
    assert 0.6 < counts[STEPS] / counts[half] < 0.72
    fewer = [step for step in range(half + 1, STEPS + 1) if counts[step] < counts[step - 1]]
    assert {round(share * STEPS) for share in SHARES} <= set(fewer)  # and floaters


def test_the_picture_changes_far_less_than_without_a_tenth_at_random(tmp_path):
    start = cloud(300, 40, 30, degree=0)
    left = sparser(trainer(tmp_path, start), start, SHARES[0], AdaptiveDensity(10.0, 3))
    kept = np.isin(start.means[:, 0], left.means[:, 0])
    at_random = np.random.default_rng(0).permutation(kept)
    picture, chosen, random = (
        render(start.take(rows), WHERE, RasterSettings()).image
        for rows in (np.ones(300, bool), kept, at_random)
    )
    assert kept.sum() == len(left) == 270
    assert np.square(chosen - picture).sum() < 0.1 * np.square(random - picture).sum()


@pytest.mark.parametrize("share", [0.1, 0.5, 0.6, 0.9, 1.0])
def test_between_these_steps_nothing_is_removed(tmp_path, share):
    start = cloud(100, 40, 30, degree=0)
    left = sparser(trainer(tmp_path, start), start, share, AdaptiveDensity(10.0, 3))
    assert len(left) == 100


def test_splats_outside_the_bounds_stay(tmp_path):
    start = cloud(200, 40, 30, degree=0)
    middle = float(np.median(start.means[:, 0]))
    bounds = (-1e9, -1e9, middle, 1e9)
    density = BoundedDensity(AdaptiveDensity(10.0, 3), bounds)
    left = sparser(trainer(tmp_path, start, bounds), start, SHARES[0], density)
    assert len(left) < 200
    assert (left.means[:, 0] >= middle).sum() == (start.means[:, 0] >= middle).sum()


def test_splats_that_are_not_finite_do_not_stop_it(tmp_path):
    start = cloud(100, 40, 30, degree=0)
    start.means[3] = np.nan
    left = sparser(trainer(tmp_path, start), start, SHARES[0], AdaptiveDensity(10.0, 3))
    assert np.isfinite(left.means).all()
    assert 85 < len(left) < 99


def test_one_splat_stays(tmp_path):
    start = cloud(1, 40, 30, degree=0)
    left = sparser(trainer(tmp_path, start), start, SHARES[0], AdaptiveDensity(10.0, 3))
    assert len(left) == 1
