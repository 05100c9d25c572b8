"""What moved between photographs is ignored; what the model cannot show, or the light, is not."""

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from stages.base.stage import Report
from stages.raster.draw import render
from stages.scene import (
    IGNORE,
    TRANSPARENT,
    DrawSettings,
    Reconstruction,
    TrainedSplats,
    View,
    look_at,
)
from stages.scene.pictures import mask_of
from stages.train import stage as train
from stages.train.checkpoint import load_checkpoint
from stages.train.conversion import model_of
from stages.train.hooks import Transients
from stages.train.schedule import HALF_SIZE_END, Schedule
from stages.train.transients import PARTS, Comparison, join_masks, save_masks, without
from stages.train.views import Level
from tests.scenes import camera, splats
from tests.train.pictures import trainer_of, view_of

STEPS = 100
WIDTH, HEIGHT = 4 * 2 * PARTS, 3 * 2 * PARTS  # parts of two pixels at a quarter of the size
FIGURE = (slice(48, 104), slice(80, 128))  # rows and columns that it covers
SKIN = (0.9, 0.3, 0.2)


def wall():
    """A wall of splats of several greens, 3 units in front of the cameras."""
    at = np.stack(np.meshgrid(np.arange(-3, 3, 0.12), np.arange(-2.5, 2.5, 0.12), [3.0]), -1)
    means = at.reshape(-1, 3)
    tints = np.random.default_rng(0).uniform((0.1, 0.4, 0.1), (0.3, 0.8, 0.3), (len(means), 3))
    return splats(means, 0.1, 0.95, tints)


def photographs(change, count=7):
    """[(picture [H, W, 3], camera)] of the wall; `change(number, picture)` edits each."""
    taken = []
    for number in range(count):
        pose = look_at(np.array([0.2 * number - 0.6, 0.0, 0.0]), np.array([0.0, 0.0, 3.0]))
        where = camera(WIDTH, HEIGHT, 180.0, matrix=pose)
        picture = np.clip(render(wall(), where).image, 0, 1)
        change(number, picture)
        taken.append((picture, where))
    return taken


def trainer(folder, taken, outside="", mask=None, steps=STEPS):
    views = [view_of(f"{i}", picture, where) for i, (picture, where) in enumerate(taken)]
    schedule = Schedule(steps=steps, extent=3.0, sh_degree=0, n_start=len(wall()), seed=0)
    made = trainer_of(
        *(schedule, views, [], DrawSettings(near=0.1), len(wall()), folder, Report()), backend="cpu"
    )
    made.stepper.load(model_of(wall()))
    return made


FULL_SIZE_FROM = round(HALF_SIZE_END * STEPS)


def transient(made, step=FULL_SIZE_FROM):
    """[views] parts of each view after this step."""
    Transients().after_step(made, step)
    return made.transient


def with_figure(number, picture):
    if number in (1, 4):
        picture[FIGURE] = SKIN


def test_a_figure_in_two_photographs_is_ignored_there_and_nowhere_else(tmp_path):
    taken = photographs(with_figure)
    made = trainer(tmp_path, taken)
    found = transient(made)
    for number, parts in enumerate(found):
        level = without(made.task.views[number].levels[-1], parts)
        if number not in (1, 4):
            assert level.mask is None
            continue
        figure = np.zeros((HEIGHT, WIDTH), bool)
        figure[FIGURE] = True
        assert level.outside == IGNORE
        assert level.mask is not None
        assert (level.mask[figure] == 0).all()
        assert (level.mask[~figure] == 0).mean() < 0.1


def darker(number, picture):
    if number == 2:
        picture[FIGURE] *= 0.6  # a shadow


def everywhere(_, picture):
    picture[FIGURE] = SKIN  # of the same place of the picture: the model is wrong there in all


def few(number, picture):
    if number == 1:
        picture[48:56, 80:88] = SKIN  # a hundredth of one picture


@pytest.mark.parametrize("change", [darker, everywhere, few, lambda *_: None])
def test_shadows_and_what_no_photograph_confirms_are_not_ignored(change, tmp_path):
    found = transient(trainer(tmp_path, photographs(change)))
    assert not any(parts.any() for parts in found)


def test_nothing_is_decided_before_the_run_draws_at_full_size(tmp_path):
    assert transient(trainer(tmp_path, photographs(with_figure)), 5) == []


def test_the_step_forgets_views_once_parts_of_them_are_ignored(tmp_path, monkeypatch):
    made = trainer(tmp_path, photographs(with_figure))
    calls = []
    monkeypatch.setattr(made.stepper, "forget_views", lambda: calls.append(len(made.transient)))
    transient(made)
    assert calls == [7]


def test_a_photograph_much_longer_than_wide_has_parts_too():
    where = camera(16, 48 * 16, 180.0)
    level = view_of("a", np.full((48 * 16, 16, 3), 0.5), where).levels[1]
    compared = Comparison.of(level, render(wall(), level.camera), (0.0, 0.0, 0.0))
    assert compared.camera.width == 1
    assert np.isfinite(compared.differences).all()


def test_a_cut_out_photograph_is_not_masked_further():
    pixels = np.full((30, 40, 3), 90, np.uint8)
    mask = np.full((30, 40), 255, np.uint8)
    level = Level.from_pixels(camera(40, 30), pixels, mask, TRANSPARENT)
    assert without(level, np.ones((3, 4), bool)) is level


def test_a_mask_of_the_user_stays_ignored():
    mask = np.full((30, 40), 255, np.uint8)
    mask[:10] = 0
    level = Level.from_pixels(camera(40, 30), np.full((30, 40, 3), 90, np.uint8), mask, IGNORE)
    parts = np.zeros((3, 4), bool)
    parts[2, 0] = True
    ignored = without(level, parts).mask
    assert ignored is not None
    assert np.count_nonzero(ignored == 0) == 10 * 40 + 10 * 10


def test_a_run_goes_on_with_the_parts_that_it_had_decided_on(tmp_path):
    made = trainer(tmp_path, photographs(with_figure))
    before = transient(made)
    made.save(20)
    stored = load_checkpoint(tmp_path, lambda *_: None)
    assert stored is not None
    again = replace(made)
    again.begin(wall())
    for read, resumed, parts in zip(stored[1].transient, again.transient, before, strict=True):
        np.testing.assert_array_equal(read, parts)
        np.testing.assert_array_equal(resumed, parts)


def test_later_stages_ignore_the_same_parts(tmp_path):
    taken = photographs(with_figure)
    made = trainer(tmp_path, taken)
    levels = [made.level(row) for row in range(len(taken))] if transient(made) else []
    names = [view.name for view in made.task.views]
    masks = save_masks(tmp_path, names, levels, made.transient)
    assert sorted(masks) == ["1", "4"]
    train.save(tmp_path, TrainedSplats(wall(), masks=masks))
    found = train.load(tmp_path).masks
    views = tuple(View(str(i), f"{i}.png", where) for i, (_, where) in enumerate(taken))
    no_points = (np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros(0), np.zeros(0, np.int32))
    reconstruction = Reconstruction(tmp_path, views, *no_points)
    for view, level in zip(reconstruction.with_masks(found).views, levels, strict=True):
        mask = mask_of(tmp_path, view, WIDTH, HEIGHT)
        assert (mask is None) == (level.mask is None)
        if mask is not None:
            np.testing.assert_array_equal(mask, level.mask)


def test_masks_of_a_photograph_in_several_blocks_keep_what_all_keep(tmp_path):
    def saved(folder, **masks):
        (tmp_path / folder).mkdir()
        for name, mask in masks.items():
            Image.fromarray(np.array(mask, np.uint8)).save(tmp_path / folder / f"{name}.png")
        return {name: tmp_path / folder / f"{name}.png" for name in masks}

    found = [saved("1", a=[[0, 255]], b=[[255, 0]]), saved("2", b=[[0, 255]]), {}]
    joined = join_masks(tmp_path, found)
    assert {name: np.asarray(Image.open(path)).tolist() for name, path in joined.items()} == {
        "a": [[0, 255]],
        "b": [[0, 0]],
    }


def test_ignored_parts_do_not_move_a_splat(tmp_path):
    """Steps on photographs with a figure, which is ignored, are those without it."""
    models = []
    for change in (with_figure, lambda *_: None):
        made = trainer(tmp_path, photographs(change))
        figure = transient(trainer(tmp_path, photographs(with_figure)))
        made.transient = figure
        for step in range(40, 60):
            made.step(step)
        models.append(made.model.on_host())
    np.testing.assert_allclose(models[0].sh, models[1].sh, atol=2e-4)
