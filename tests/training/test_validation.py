"""Dropout by the number of training views, and densification that stops early."""

from pathlib import Path

import numpy as np
import pytest

from stages.base.errors import Interrupted
from stages.base.stage import Report
from stages.raster.definition import RasterSettings
from stages.raster.draw import render
from stages.scene import DrawSettings
from stages.training.schedule import DENSIFICATION_END, Schedule
from stages.training.trainer import Trainer
from stages.training.validation import (
    DROPOUT_BELOW,
    EarlyStopping,
    uses_dropout,
    validation_rows,
)
from tests.scenes import camera, cloud
from tests.training.pictures import view_of

STEPS = 600
VALIDATION = 2  # the row of the validation view


def trainer(folder, contradicting, report=None, patience_db=0.05, views=4):
    """Views from one place; the validation view shows the same as the others, or noise."""
    where = camera(40, 30)
    picture = np.clip(render(cloud(80, 40, 30, degree=0), where, RasterSettings()).image, 0, 1)
    pictures = [picture] * views
    if contradicting:
        pictures[VALIDATION] = np.random.default_rng(0).random(picture.shape).astype(np.float32)
    start = cloud(60, 40, 30, degree=0, seed=4)
    schedule = Schedule(steps=STEPS, extent=10.0, sh_degree=0, n_start=len(start), seed=0)
    folder.mkdir(exist_ok=True)
    made = Trainer(
        schedule,
        [view_of(f"{k}", p, where) for k, p in enumerate(pictures)],
        [],
        DrawSettings(near=0.1),
        200,
        folder,
        report or Report(),
        backend="cpu",
        early_stopping=EarlyStopping(patience_db, (VALIDATION,)),
    )
    return made, start


def recorded(made):
    """(row of the view, whether splats were dropped) of each step, as training goes on."""
    steps, step = [], made.stepper.step

    def stepping(given):
        levels = enumerate(view.levels for view in made.train)
        (row,) = (k for k, own in levels if any(given.level is one for one in own))
        steps.append((row, given.dropout is not None))
        return step(given)

    made.stepper.step = stepping
    return steps


def test_validation_views_are_trained_on_only_after_densification(tmp_path):
    made, start = trainer(tmp_path / "a", contradicting=False)
    made.train = [view_of(f"{k}", np.full((30, 40, 3), k / 4), camera(40, 30)) for k in range(4)]
    made.early_stopping.patience_db = -1e9  # never stops
    steps = recorded(made)
    made.run(start)
    half = int(DENSIFICATION_END * STEPS)
    assert {row for row, _ in steps[:half]} == {0, 1, 3}
    assert {row for row, _ in steps[half:]} == {0, 1, 2, 3}


def test_splats_are_dropped_only_after_densification(tmp_path):
    made, start = trainer(tmp_path / "a", contradicting=False)
    steps = recorded(made)
    made.run(start)
    half = made.schedule.steps * DENSIFICATION_END
    assert [dropped for _, dropped in steps] == [k >= half for k in range(made.schedule.steps)]


@pytest.mark.parametrize(
    ("views", "dropout"), [(1, True), (DROPOUT_BELOW - 1, True), (DROPOUT_BELOW, False)]
)
def test_dropout_is_for_captures_of_few_views(tmp_path: Path, views: int, dropout: bool) -> None:
    assert uses_dropout(views) == dropout


@pytest.mark.parametrize(("n", "wanted"), [(0, 0), (7, 0), (8, 1), (12, 1), (21, 3), (300, 4)])
def test_few_views_are_set_aside_and_of_too_few_none(n, wanted):
    rows = validation_rows(n)
    assert len(rows) == len(set(rows)) == wanted
    assert all(0 <= row < n for row in rows)


def stopped_at(psnrs, patience_db=0.05, rows=2):
    """After how many of 1000 steps densification stops, where `psnrs` are found in turn."""
    stopping = EarlyStopping(patience_db, tuple(range(rows)))
    schedule = Schedule(steps=1000, extent=1.0, sh_degree=0, n_start=1, seed=0)
    found = iter(psnrs)
    current: list[float] = []
    for step in range(1, 501):
        if step % 100 == 0 and schedule.densifying(step):
            current = list(next(found))
        schedule = stopping.next_schedule(schedule, step, current.__getitem__)
    assert (stopping.stopped_at > 0) == (schedule.steps < 1000)
    return stopping.stopped_at


def test_densification_stops_when_no_view_improved_over_its_best():
    improving = [(25, 28), (25.1, 27), (25.2, 27), (25.3, 27)]
    assert stopped_at(improving) == 0
    assert stopped_at([(25, 28), (25.04, 28.0)]) == 200
    assert stopped_at([(25, 28), (25.06, 27.0), (25.1, 28.0)]) == 300
    assert stopped_at([(25, 28), (24, 28.1), (24.9, 28.1)]) == 300  # better than before, not best
    assert stopped_at(improving, rows=0) == 0


def test_where_a_view_contradicts_the_others_the_run_is_shorter(tmp_path):
    made, start = trainer(tmp_path / "a", contradicting=True)
    made.run(start)
    stopped = made.early_stopping.stopped_at
    assert 0 < stopped < DENSIFICATION_END * STEPS
    assert made.schedule.steps == 2 * stopped
    assert made.schedule.share(made.schedule.steps) == 1.0
    assert made.history[-1]["step"] == made.schedule.steps


@pytest.mark.parametrize("steps", [60, 130, 200])
def test_a_resumed_run_stops_densifying_at_the_same_step(tmp_path, steps):
    whole, start = trainer(tmp_path / "whole", contradicting=True)
    wanted = whole.run(start)
    report = Report()

    def stop(label, done, total, numbers):
        if label == "training" and done == steps:
            report.stop_requested.set()

    report.listener = stop
    first, start = trainer(tmp_path / "parts", contradicting=True, report=report)
    with pytest.raises(Interrupted):
        first.run(start)
    second, start = trainer(tmp_path / "parts", contradicting=True)
    found = second.run(start)
    assert second.schedule == whole.schedule
    assert second.early_stopping == whole.early_stopping
    for a, b in zip(vars(found).values(), vars(wanted).values(), strict=True):
        assert a.tobytes() == b.tobytes()
