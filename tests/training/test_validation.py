"""Photographs that training lends: they tell whether it learns the others by heart."""

import itertools

import numpy as np
import pytest

from stages.base.errors import Interrupted
from stages.base.stage import Report
from stages.raster.definition import RasterSettings
from stages.raster.draw import render
from stages.scene import DrawSettings
from stages.train import validation_rows
from stages.training import trainer as training
from stages.training import validation
from stages.training.checkpoint import checkpoint_files, load_checkpoint, remove_checkpoint
from stages.training.schedule import GROWTH_ENDS, Schedule
from stages.training.trainer import Trainer
from stages.training.validation import LASTS, Answer, gives_too_little, trial_at
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
        *(schedule, views, [], DrawSettings(near=0.1), 200, folder, report or Report()),
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
    rows = validation_rows(n)
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
def test_where_growth_ends_both_ways_are_gone_from_the_same_model_and_forgotten(
    tmp_path, monkeypatch, doubt_db, dropout
):
    monkeypatch.setattr(training, "DOUBT_DB", doubt_db)
    made, start = trainer(tmp_path / "a", contradicting=False, patience_db=0.0)
    steps, loads = watched(made)
    made.run(start)
    half, lasts = int(GROWTH_ENDS * STEPS), round(LASTS * STEPS)
    plain, other = (slice(half + k * lasts, half + (k + 1) * lasts) for k in range(2))
    assert len(steps) == STEPS + 2 * lasts
    assert not any(dropout for _, dropout in steps[: plain.stop])
    assert all(dropout for _, dropout in steps[other])
    assert all(dropout == dropout for _, dropout in steps[other.stop :])
    assert [row for row, _ in steps[plain]] == [row for row, _ in steps[other]]
    assert LENT not in {row for row, _ in steps[: other.stop]}
    assert LENT in {row for row, _ in steps[other.stop :]}
    at = dict(loads)
    assert at[plain.start] == at[other.start] == at[other.stop]
    assert made.dropout is dropout


def test_a_trial_settles_as_the_end_of_a_run_does():
    schedule = Schedule(steps=4000, extent=10.0, sh_degree=2, n_start=9, seed=0)
    course = schedule.settling(1000, 1200)
    end, last = schedule.steps - 1, 1199
    assert course.means_lr(last) / course.boost == pytest.approx(
        schedule.means_lr(end) / schedule.boost, rel=0.05
    )
    assert course.level(1000) == schedule.level(end)
    assert course.active_sh_degree(1000) == schedule.active_sh_degree(end) == 2
    assert not any(course.grows(step) or course.densifies_after(step) for step in range(1000, 1200))


def trials(steps, often=True):
    schedule = Schedule(steps=steps, extent=1.0, sh_degree=0, n_start=1, seed=0)
    return [step for step in range(1, steps) if trial_at(step, schedule, often)]


def test_lent_photographs_are_asked_where_growth_ends_and_in_long_runs_at_each_doubling():
    assert trials(30_000) == [1875, 3750, 7500, 15_000]
    assert trials(7000) == [1750, 3500]
    assert trials(3000) == [1500]
    assert trials(2) == []  # nothing is left to be decided
    assert trials(30_000, often=False) == [15_000]


def test_a_run_that_is_planned_anew_asks_at_the_same_places_of_its_course():
    before = Schedule(steps=7000, extent=1.0, sh_degree=0, n_start=1, seed=0)
    after = before.replanned(1000, 15_000)
    asked = [step for step in range(1001, 15_000) if trial_at(step, after, often=True)]
    assert [round(after.share(step), 3) for step in asked] == [0.25, 0.5]


def answers(*best_db):
    """Of two photographs each time, better where splats sit out."""
    return [Answer(k, k, (a - 1.0, b - 1.0), (a, b)) for k, (a, b) in enumerate(best_db)]


def test_growth_ends_where_growing_on_gave_no_photograph_what_was_wished():
    assert not gives_too_little(answers((25.0, 28.0)), 0.05)
    assert not gives_too_little(answers((25.0, 28.0), (25.1, 28.1)), 0.05)
    assert gives_too_little(answers((25.0, 28.0), (25.04, 28.0)), 0.05)
    assert not gives_too_little(answers((25.0, 28.0), (25.06, 27.0)), 0.05)  # one is enough
    assert gives_too_little(answers((24.0, 27.0), (25.0, 28.0), (24.0, 27.5)), 0.05)


def test_what_counts_is_the_better_way_by_all_photographs():
    plain = Answer(1, 1, (25.0, 28.0), (24.0, 27.0))
    mixed = Answer(2, 2, (25.0, 28.0), (27.0, 27.0))
    assert plain.best_db == (25.0, 28.0)
    assert mixed.best_db == (27.0, 27.0)
    assert mixed.gain_db == pytest.approx(0.5)
    assert mixed.gained_db(plain) == pytest.approx(2.0)


@pytest.fixture
def early(monkeypatch):
    """Lent photographs are asked in short runs, too: at 75, 150 and 300 of 600 steps."""
    monkeypatch.setattr(validation, "EARLIEST", 70)


@pytest.mark.usefixtures("early")
def test_what_gives_others_nothing_is_taken_back_and_says_so(tmp_path):
    made, start = trainer(tmp_path / "a", contradicting=True)
    steps, loads = watched(made)
    model = made.run(start)
    *_, kept, last = made.answers
    assert last.gained_db(kept) < 0.05
    assert f"from {kept.splats:,} to {last.splats:,} splats" in made.ended
    assert made.schedule.steps == 2 * kept.step
    assert made.schedule.share(made.schedule.steps) == 1.0
    assert len(model) <= kept.splats < last.splats
    assert len(steps) > last.step  # it did go on
    loaded = [models for _, models in loads]
    assert max(map(loaded.count, loaded)) == 4  # grown, after either way of the trial, going back
    assert made.gain_db == kept.gain_db
    assert all(entry["step"] <= made.schedule.steps for entry in made.history)
    assert sorted(h["step"] for h in made.history) == [h["step"] for h in made.history]


@pytest.mark.usefixtures("early")
def test_what_others_gain_from_goes_its_whole_way(tmp_path):
    made, start = trainer(tmp_path / "a", contradicting=False)
    made.run(start)
    assert (made.ended, made.schedule.steps) == ("", STEPS)
    assert len(made.answers) == 3


@pytest.mark.usefixtures("early")
def test_without_patience_nothing_is_cut_short(tmp_path):
    made, start = trainer(tmp_path / "a", contradicting=True, patience_db=0.0)
    made.run(start)
    assert (made.ended, made.schedule.steps) == ("", STEPS)


def stopped_at(steps, folder):
    """A run that was stopped after so many of its steps, trials counted."""
    report, count = Report(), itertools.count(1)

    def stop(label, done, total, numbers):
        if label.startswith("training") and next(count) == steps:
            report.stop_requested.set()

    report.listener = stop
    made, start = trainer(folder, contradicting=True, report=report)
    with pytest.raises(Interrupted):
        made.run(start)


@pytest.mark.usefixtures("early")
@pytest.mark.parametrize("steps", [60, 90, 130, 170, 200, 240, 280, 320, 380])
def test_a_stopped_run_keeps_its_plan_and_what_was_told(tmp_path, steps):
    whole, start = trainer(tmp_path / "whole", contradicting=True)
    wanted = whole.run(start)
    assert whole.ended
    stopped_at(steps, tmp_path / "parts")
    second, start = trainer(tmp_path / "parts", contradicting=True)
    found = second.run(start)
    assert second.schedule == whole.schedule
    assert (second.answers, second.ended) == (whole.answers, whole.ended)
    for a, b in zip(vars(found).values(), vars(wanted).values(), strict=True):
        assert a.tobytes() == b.tobytes()


def test_what_a_trial_puts_aside_goes_with_the_checkpoint(tmp_path):
    made, start = trainer(tmp_path / "a", contradicting=False)
    made.run(start)
    remove_checkpoint(tmp_path / "a")
    assert not list((tmp_path / "a").iterdir())


def test_a_checkpoint_without_the_model_that_was_put_aside_is_none(tmp_path):
    stopped_at(STEPS // 2 + 10, tmp_path)
    *aside, checkpoint = checkpoint_files(tmp_path)
    assert load_checkpoint(tmp_path) is not None
    assert aside
    assert (tmp_path / checkpoint).exists()
    (tmp_path / aside[0]).unlink()
    assert load_checkpoint(tmp_path) is None
