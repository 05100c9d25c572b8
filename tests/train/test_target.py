"""Masked regions are ignored in training, or trained to be empty."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stages.base.stage import Report
from stages.raster.definition import RasterSettings, splat_arrays
from stages.raster.draw import render
from stages.scene import IGNORE, TRANSPARENT, DrawSettings, Splats
from stages.train.loop import train as train_all
from stages.train.loss import channel_means
from stages.train.optimiser import LearningRates, new_model
from stages.train.schedule import SCALES, Schedule
from stages.train.steps.step import StepInput, step_of
from stages.train.views import Level, TrainingView
from tests.scenes import BACKENDS, camera, cloud, join, splats
from tests.train.pictures import trainer_of

WHERE = camera(48, 48)
LEFT = np.repeat(np.array([255, 0], np.uint8), 24)[None] * np.ones((48, 1), np.uint8)


def level(picture: np.ndarray, outside: str) -> Level:
    pixels = np.ascontiguousarray(np.rint(picture * 255).astype(np.uint8).transpose(2, 0, 1))
    return Level(WHERE, pixels, channel_means(pixels), LEFT, outside)


def after_one_step(backend: str, picture: np.ndarray, start: Splats) -> np.ndarray:
    stepper = step_of(backend)
    stepper.load(new_model(*(array.copy() for array in splat_arrays(start))))
    settings = RasterSettings(near=0.1, sh_degree=0)
    stepper.step(StepInput(level(picture, IGNORE), settings, LearningRates()))
    return stepper.model().sh


@pytest.mark.parametrize("backend", BACKENDS)
def test_what_stands_behind_an_ignored_part_changes_nothing(backend: str) -> None:
    start, picture = cloud(60, 48, 48, degree=0), np.random.default_rng(0).random((48, 48, 3))
    other = picture.copy()
    other[:, 24:] = 1 - other[:, 24:]
    np.testing.assert_array_equal(
        after_one_step(backend, picture, start), after_one_step(backend, other, start)
    )


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_splat_that_only_an_ignored_part_shows_stays_as_it_is(backend: str) -> None:
    hidden = splats([[0.3, 0.0, 1.0]], scales=0.02)  # at the right of the picture
    assert render(hidden, WHERE).alpha[:, :24].max() == 0 < render(hidden, WHERE).alpha.max()
    picture = np.random.default_rng(1).random((48, 48, 3))
    np.testing.assert_array_equal(after_one_step(backend, picture, hidden), hidden.sh)


def black(columns: tuple[float, ...], scale: float) -> Splats:
    """Four splats in each of these columns, over the right half, which is masked."""
    means = [[x, y, 0.9] for x in columns for y in (-0.3, -0.1, 0.1, 0.3)]
    return splats(means, rgb=(0.0, 0.0, 0.0), scales=scale, opacities=0.6)


REACHING, APART = black((0.1, 0.2, 0.3), 0.1), black((0.2, 0.3, 0.4), 0.04)


def trained(outside: str, folder: Path, dark: Splats = REACHING) -> Splats:
    """A red disc on the left, and black splats over the right half, which is masked. Trained for so
    many steps that no splat which covers the black of the left half still reaches into the right.
    """
    red = splats([[-0.3, 0.0, 1.0]], rgb=(0.9, 0.1, 0.1), scales=0.08, opacities=0.9)
    picture = render(red, WHERE).image.copy()
    view = TrainingView("a", tuple(level(np.clip(picture, 0, 1), outside) for _ in SCALES))
    start = join(red, dark)
    schedule = Schedule(steps=800, extent=10.0, sh_degree=0, n_start=len(start), seed=0)
    draw_settings = DrawSettings(near=0.1)
    made = trainer_of(schedule, [view], [], draw_settings, len(start), folder, Report())
    model = train_all(made, start)
    arrays = model.means, model.quaternions, model.log_scales, model.opacity_logits, model.sh
    return Splats(*arrays, np.zeros(len(model), np.uint8))


def test_what_is_cut_out_is_empty_in_the_end_over_any_colour(tmp_path: Path) -> None:
    """Black splats do not show over black, where the photograph came from."""
    alpha = render(trained(TRANSPARENT, tmp_path), WHERE).alpha[:, 32:]
    assert alpha.mean() < 0.01


def test_what_only_ignored_parts_show_stays_as_it_is_or_is_removed(tmp_path: Path) -> None:
    """To the end of a run; removed by sparsification, as no photograph shows it."""
    found = trained(IGNORE, tmp_path, APART)
    assert render(APART, WHERE).alpha[:, :24].max() == 0
    kept = found.means[:, 0] > 0.1
    rows = {tuple(mean): row for row, mean in enumerate(APART.means)}
    begun = [rows[tuple(mean)] for mean in found.means[kept]]
    assert begun
    for name in ("opacity_logits", "log_scales", "sh"):
        np.testing.assert_array_equal(getattr(found, name)[kept], getattr(APART, name)[begun])


@pytest.mark.parametrize("over_any", [False, True])
def test_what_is_black_is_there_if_a_scene_is_for_any_background(
    over_any: bool, tmp_path: Path
) -> None:
    start = splats(
        [[x, y, 1.0] for x in (-0.2, 0.0, 0.2) for y in (-0.2, 0.0, 0.2)],
        rgb=(0.0, 0.0, 0.0),
        scales=0.12,
        opacities=0.4,
    )
    black = replace(level(np.zeros((48, 48, 3)), ""), mask=None)
    view = TrainingView("a", tuple(black for _ in SCALES))
    schedule = Schedule(steps=150, extent=10.0, sh_degree=0, n_start=9, seed=0)
    draw_settings = DrawSettings(near=0.1)
    made = trainer_of(
        schedule, [view], [], draw_settings, 9, tmp_path, Report(), any_background=over_any
    )
    model = train_all(made, start)
    opacities = 1 / (1 + np.exp(-model.opacity_logits))
    assert (opacities.mean() > 0.7) == over_any
