"""The average of the parameters over the end of a run."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from stages.base.stage import Report
from stages.scene import Splats
from stages.train.average import ParameterAverage
from stages.train.checkpoint import TrainingState, load_checkpoint, save_checkpoint
from stages.train.free_space import FreeSpace
from stages.train.hooks import Averaging, FloaterRemoval
from stages.train.loop import train
from stages.train.optimiser import Model, new_model
from stages.train.schedule import Schedule
from stages.train.trainer import Trainer
from tests.scenes import camera, cloud
from tests.train.pictures import trainer_of, view_of

# of a running mean of 20 float32 numbers of about 1: each addition rounds by 6e-8 of it
ROUNDING = 20 * 6e-8


def model(seed: int, splats: int = 20) -> Model:
    start = cloud(splats, degree=1, seed=seed)
    parameters = (start.means, start.quaternions, start.log_scales, start.opacity_logits, start.sh)
    return new_model(*(np.array(values, np.float32) for values in parameters))


def average_of(models: list[Model]) -> ParameterAverage:
    average = ParameterAverage()
    for each in models:
        average.add(each)
    return average


@pytest.mark.parametrize("count", [1, 2, 20])
def test_it_is_the_mean_of_every_parameter(count: int) -> None:
    models = [model(seed) for seed in range(count)]
    found = average_of(models).written_to(model(99))
    for column, array in enumerate(found.arrays):
        wanted = np.mean([m.arrays[column] for m in models], axis=0, dtype=np.float64)
        np.testing.assert_allclose(array, wanted, rtol=ROUNDING, atol=4 * ROUNDING)  # values to 4


def test_models_that_do_not_change_stay_what_they_are() -> None:
    same = average_of([model(3)] * 20).written_to(model(4))
    for a, b in zip(same.arrays, model(3).arrays, strict=True):
        assert a.tobytes() == b.tobytes()


def test_models_are_not_changed_by_being_averaged() -> None:
    first, second = model(1), model(2)
    average_of([first, second])
    for a, b in zip(first.arrays, model(1).arrays, strict=True):
        assert a.tobytes() == b.tobytes()


def test_a_splat_that_is_not_finite_spoils_no_other() -> None:
    broken = model(2)
    broken.means[3], broken.sh[4] = np.inf, np.nan
    found = average_of([model(1), broken, model(3)]).written_to(model(9))
    np.testing.assert_array_equal(np.flatnonzero(~found.finite()), [3, 4])


def test_with_fewer_splats_it_begins_anew() -> None:
    average = average_of([model(1), model(2), model(3, splats=10)])
    assert average.count == 1
    assert len(average.arrays[0]) == 10


def test_a_checkpoint_keeps_it(tmp_path: Path) -> None:
    average = average_of([model(1), model(2)])
    state = TrainingState(7, (30, 0, 0.0), [], [], [], average=average)
    save_checkpoint(tmp_path, model(2), state)
    loaded = load_checkpoint(tmp_path, lambda code, message: None)
    assert loaded is not None
    assert loaded[1].average.count == 2
    for a, b in zip(loaded[1].average.arrays, average.arrays, strict=True):
        assert a.tobytes() == b.tobytes()


def run_of(folder: Path, steps: int) -> tuple[Trainer, Splats]:
    """A run that looks at two unlike pictures in turn, so that each step undoes the one before."""
    where, start = camera(40, 30), cloud(60, 40, 30, degree=0, seed=4)
    grey = np.full((30, 40, 3), 0.5, np.float32)
    views = [view_of("dark", grey * 0.4, where), view_of("bright", grey * 1.6, where)]
    schedule = Schedule(steps=steps, extent=10.0, sh_degree=0, n_start=len(start), seed=0)
    drawn = start.draw_settings
    return trainer_of(schedule, views, [], drawn, 10_000, folder, Report(), backend="cpu"), start


def test_a_run_ends_in_the_average_of_its_last_tenth(tmp_path: Path, monkeypatch) -> None:
    trainer, start = run_of(tmp_path, 200)
    seen: list[list[np.ndarray]] = []
    add = ParameterAverage.add

    def recorded(self: ParameterAverage, given: Model) -> None:
        seen.append([array.copy() for array in given.arrays])
        add(self, given)

    monkeypatch.setattr(ParameterAverage, "add", recorded)
    found = train(trainer, start)
    assert len(seen) == 20
    for column, array in enumerate(found.arrays):
        wanted = np.mean([arrays[column] for arrays in seen], axis=0, dtype=np.float64)
        np.testing.assert_allclose(array, wanted, rtol=ROUNDING, atol=4 * ROUNDING)


class AllIsFree(FreeSpace):
    """Space in which every splat is a floater."""

    def contains(self, means: NDArray[np.floating]) -> NDArray[np.bool_]:
        return np.ones(len(means), bool)


def test_no_floater_is_removed_between_the_models_of_an_average(tmp_path: Path) -> None:
    trainer, start = run_of(tmp_path, 200)
    trainer.begin(start)
    removal = FloaterRemoval(AllIsFree((), ()))
    for step in range(181, 200):  # 190 ends one of the parts after which floaters are removed
        Averaging().after_step(trainer, step)
        removal.after_step(trainer, step)
        assert len(trainer.stepper) == len(start)
    Averaging().after_step(trainer, 200)
    removal.after_step(trainer, 200)
    assert len(trainer.stepper) == 0
