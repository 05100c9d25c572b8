"""Photographs that training lends: they tell whether it learns the others by heart."""

import itertools

import numpy as np
import pytest

from stages.base.errors import Interrupted
from stages.base.stage import Report
from stages.raster.definition import RasterSettings
from stages.raster.draw import render
from stages.scene import Look
from stages.train import lent_rows
from stages.training import trainer as training
from stages.training.checkpoint import remove_checkpoint
from stages.training.schedule import GROWTH_ENDS, Schedule
from stages.training.trainer import Trainer
from stages.training.trial import LASTS
from tests.scenes import camera, cloud
from tests.training.pictures import view_of

STEPS = 600
LENT = 2  # the row that is lent


def trainer(folder, contradicting, patience_db=0.05, report=None):
    """Four photographs from one place; the one that is lent shows the same, or something else."""
    where = camera(40, 30)
    picture = np.clip(render(cloud(80, 40, 30, degree=0), where, RasterSettings()).image, 0, 1)
    other = np.random.default_rng(0).random(picture.shape).astype(np.float32)
    pictures = [picture] * 4
    if contradicting:
        pictures[LENT] = other
    views = [view_of(f"{k}", p, where) for k, p in enumerate(pictures)]
    start = cloud(60, 40, 30, degree=0, seed=4)
    schedule = Schedule(steps=STEPS, extent=10.0, sh_degree=0, n_start=len(start), seed=0)
    folder.mkdir(exist_ok=True)
    made = Trainer(
        *(schedule, views, [], Look(near=0.1), 200, folder, report or Report()),
        backend="cpu",
        lent=(LENT,),
        patience_db=patience_db,
    )
    return made, start


def test_no_photograph_that_is_lent_is_trained_on_while_the_model_grows_and_all_are_afterwards(
    tmp_path,
):
    made, _ = trainer(tmp_path / "a", contradicting=False)
    growing = [made._row(step) for step in range(int(GROWTH_ENDS * STEPS))]
    assert set(growing) == {0, 1, 3}
    assert {made._row(step) for step in range(int(GROWTH_ENDS * STEPS), STEPS)} == {0, 1, 2, 3}


@pytest.mark.parametrize(("n", "wanted"), [(0, 0), (7, 0), (8, 1), (12, 1), (21, 3), (300, 4)])
def test_few_are_lent_and_of_too_few_none(n, wanted):
    rows = lent_rows(n)
    assert len(rows) == len(set(rows)) == wanted
    assert all(0 <= row < n for row in rows)


def watched(made):
    """What becomes of each step: (which photograph, whether splats sat out), and the models that
    steps began from where the trainer loaded one."""
    steps, loads, (step, load) = [], [], (made.stepper.step, made.stepper.load)

    def stepping(level, settings, rates, smooth, dropout):
        row = [view.levels[0] is level or view.levels[1] is level for view in made.train].index(
            True
        )
        steps.append((row, dropout is not None))
        return step(level, settings, rates, smooth, dropout)

    def loading(model):
        loads.append((len(steps), [array.tobytes() for array in vars(model).values()]))
        load(model)

    made.stepper.step, made.stepper.load = stepping, loading
    return steps, loads


@pytest.mark.parametrize(("doubt_db", "sits_out"), [(-99.0, True), (99.0, False)])
def test_where_growth_ends_both_ways_are_gone_from_the_same_model_and_one_is_kept(
    tmp_path, monkeypatch, doubt_db, sits_out
):
    monkeypatch.setattr(training, "DOUBT_DB", doubt_db)
    made, start = trainer(tmp_path / "a", contradicting=False, patience_db=0.0)
    steps, loads = watched(made)
    made.run(start)
    half, lasts = int(GROWTH_ENDS * STEPS), round(LASTS * STEPS)
    plain, other, rest = (slice(half + k * lasts, half + (k + 1) * lasts) for k in range(3))
    assert not any(sat_out for _, sat_out in steps[: plain.stop])
    assert all(sat_out for _, sat_out in steps[other])
    assert all(sat_out == sits_out for _, sat_out in steps[rest.start :])
    assert len(steps) == STEPS + lasts
    assert [row for row, _ in steps[plain]] == [row for row, _ in steps[other]]
    assert LENT not in {row for row, _ in steps[: rest.start]}
    assert LENT in {row for row, _ in steps[rest.start :]}
    at = dict(loads)
    assert at[other.start] == at[plain.start]
    assert (rest.start in at) is not sits_out  # what sat out goes on as it is
    assert made.sits_out is sits_out


def test_what_the_trial_puts_aside_goes_with_the_checkpoint(tmp_path):
    made, start = trainer(tmp_path / "a", contradicting=False)
    made.run(start)
    remove_checkpoint(tmp_path / "a")
    assert not list((tmp_path / "a").iterdir())


def test_what_is_learnt_by_heart_is_cut_short_and_says_so(tmp_path):
    made, start = trainer(tmp_path / "a", contradicting=True)
    made.run(start)
    assert "promised no more" in made.ended
    assert made.schedule.steps < 0.8 * STEPS
    assert made.schedule.share(made.schedule.steps) == 1.0


def test_what_others_gain_from_goes_its_whole_way(tmp_path):
    made, start = trainer(tmp_path / "a", contradicting=False)
    made.run(start)
    assert (made.ended, made.schedule.steps) == ("", STEPS)


def test_without_patience_nothing_is_cut_short(tmp_path):
    made, start = trainer(tmp_path / "a", contradicting=True, patience_db=0.0)
    made.run(start)
    assert (made.ended, made.schedule.steps) == ("", STEPS)


@pytest.mark.parametrize("share", [0.3, 0.55, 0.63, 0.9])
def test_a_stopped_run_keeps_its_plan_and_what_was_told(tmp_path, share):
    whole, start = trainer(tmp_path / "whole", contradicting=True)
    wanted = whole.run(start)
    stop_at, report = int(share * whole.schedule.steps), Report()
    count = itertools.count(1)

    def stop(label, done, total, numbers):
        if label.startswith("training") and next(count) == stop_at:
            report.stop_requested.set()

    report.listener = stop
    first, start = trainer(tmp_path / "parts", True, report=report)
    with pytest.raises(Interrupted):
        first.run(start)
    second, start = trainer(tmp_path / "parts", contradicting=True)
    found = second.run(start)
    assert second.schedule == whole.schedule
    assert (second.marks, second.gain_db) == (whole.marks, whole.gain_db)
    for a, b in zip(vars(found).values(), vars(wanted).values(), strict=True):
        assert a.tobytes() == b.tobytes()
