"""Splats that contribute least are removed while training goes on."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stages.base.stage import Report
from stages.raster.definition import RasterSettings
from stages.raster.draw import render
from stages.scene import TRANSPARENT, DrawSettings, evenly_spaced
from stages.train import sparsification
from stages.train.conversion import model_of
from stages.train.density import AdaptiveDensity, BoundedDensity
from stages.train.hooks import FLOATER_REMOVALS
from stages.train.loop import train as train_all
from stages.train.schedule import DENSIFICATION_END, Schedule
from stages.train.sparsification import (
    LARGEST_ROUND,
    LOSS_DB,
    SHARES,
    Sparsification,
    spare_error,
)
from tests.scenes import camera, cloud, join, splats
from tests.train.pictures import trainer_of, view_of

STEPS = 300
WHERE = camera(40, 30)
NOISE = 0.1  # of the photographs: 20 dB, so that there is an error which a loss is a part of
NEAR = DrawSettings(near=0.1)
RULE = AdaptiveDensity(3)


HALF_TURN = np.diag([-1.0, 1.0, -1.0, 1.0])


def drawn(scene, where=WHERE):
    return np.clip(render(scene, where, RasterSettings()).image, 0, 1)


def moved(x):
    """The world-to-camera matrix of a camera at (x, 0, 0)."""
    matrix = np.eye(4)
    matrix[0, 3] = -x
    return matrix


def noisy(picture, noise=NOISE):
    return np.clip(picture + np.random.default_rng(0).normal(0, noise, picture.shape), 0, 1)


def trainer(folder, start, within=(), views=None, draw=NEAR):
    """A run on a noisy picture of `start`, or on other views, that does not densify."""
    schedule = Schedule(steps=STEPS, extent=10.0, sh_degree=0, n_start=len(start), seed=0)
    views = views or [view_of(f"{k}", noisy(drawn(start)), WHERE) for k in range(3)]
    return trainer_of(
        *(schedule, views, [], draw, len(start), folder, Report()), backend="cpu", within=within
    )


def sparser(made, start, share=SHARES[0], density=RULE):
    """The model after the step that reaches this share of the run."""
    made.stepper.load(model_of(start))
    Sparsification(start, density).after_step(made, round(share * STEPS))
    return made.model


def test_splats_are_removed_after_densification_at_the_planned_steps_only(tmp_path):
    start = cloud(400, 40, 30, degree=0)
    counts = {}
    made = trainer(tmp_path, start)
    made.task.report.listener = lambda label, done, total, numbers: counts.update(
        {done: numbers["splats"]} if label == "training" else {}
    )
    end = train_all(made, start)
    half = int(DENSIFICATION_END * STEPS)
    assert len(end) == counts[STEPS] < counts[half]
    fewer = [step for step in range(half + 1, STEPS + 1) if counts[step] < counts[step - 1]]
    rounds = {round(share * STEPS) for share in SHARES}
    floaters = {round(STEPS * part / FLOATER_REMOVALS) for part in range(FLOATER_REMOVALS + 1)}
    assert set(fewer) <= rounds | floaters
    assert set(fewer) & rounds


LARGE = camera(160, 120)  # ten views of it have many pixel values for each of 600 splats


def faint_scene():
    """600 small splats, of which none is hidden."""
    faint = np.random.default_rng(0).uniform(-3, 0.5, 600).astype(np.float32)
    return replace(cloud(600, 40, 30, degree=0, size_px=1.0), opacity_logits=faint)


def left_of(start, where, views, folder):
    """What a round leaves of `start`, seen in equal noisy `views`."""
    picture = noisy(drawn(start, where), 0.03)
    seen = [view_of(f"{k}", picture, where) for k in range(views)]
    left = sparser(trainer(folder, start, views=seen), start)
    kept = start.take(np.isin(start.means[:, 0], left.means[:, 0]))
    change = np.square(drawn(kept, where) - drawn(start, where)).sum()
    return len(left), change, np.square(drawn(start, where) - picture).sum()


def test_a_round_costs_no_more_than_its_part_of_the_bound_where_photographs_are_many(tmp_path):
    start = faint_scene()
    left, change, sse = left_of(start, LARGE, 10, tmp_path)
    assert 0 < 600 - left < 120  # the bound and not the largest share of a round decides
    allowed = sse * (10 ** (LOSS_DB / len(SHARES) / 10) - 1)
    # removed splats may lie over each other, which sums of single changes do not know
    assert 0.5 * allowed < change < 1.5 * allowed


def test_with_few_pixel_values_for_each_parameter_more_splats_go(tmp_path):
    start = faint_scene()
    few, change, sse = left_of(start, WHERE, 3, tmp_path / "few")
    many, *_ = left_of(start, WHERE, 30, tmp_path / "many")
    assert few < many
    # and by no more than as many free parameters would lower the error of noise
    values, parameters = 3 * 3 * 40 * 30, 600 * 14
    assert 3 * change < 1.5 * (600 - few) * 14 * spare_error(3 * sse, values, parameters)


@settings(max_examples=50)
@given(
    values=st.integers(1000, 10**9),
    share=st.floats(0.0, 0.999),
    removed=st.integers(1, 59),
    sse=st.floats(1e-6, 1e6),
)
def test_generalised_cross_validation_falls_where_a_splat_saves_less_than_the_spare_error(
    values, share, removed, sse
):
    def estimate(squared_error, count):
        return squared_error * values / (values - count) ** 2

    parameters = max(removed, int(share * values))
    limit = removed * spare_error(sse, values, parameters)
    fewer = parameters - removed
    assert estimate(sse + 0.99 * limit, fewer) < estimate(sse, parameters)
    if removed < 0.01 * (values - parameters):
        assert estimate(sse + 1.02 * limit, fewer) > estimate(sse, parameters)


def test_of_more_parameters_than_pixel_values_any_splat_may_go(tmp_path):
    start = cloud(1000, 40, 30, degree=0)
    view = [view_of("0", noisy(drawn(start)), WHERE)]
    left = sparser(trainer(tmp_path, start, views=view), start)
    assert len(left) == 1000 - LARGEST_ROUND * 1000


def test_the_picture_changes_far_less_than_without_as_many_at_random(tmp_path):
    start = cloud(300, 40, 30, degree=0)
    left = sparser(trainer(tmp_path, start), start)
    kept = np.isin(start.means[:, 0], left.means[:, 0])
    at_random = np.random.default_rng(0).permutation(kept)
    picture, chosen, random = (
        drawn(start.take(rows)) for rows in (np.ones(300, bool), kept, at_random)
    )
    assert kept.sum() == len(left) < 300
    assert np.square(chosen - picture).sum() < 0.1 * np.square(random - picture).sum()


def test_splats_that_an_opaque_one_hides_are_removed_first(tmp_path):
    front = cloud(100, 40, 30, degree=0)
    front = replace(front, means=0.4 * front.means, log_scales=front.log_scales + np.log(0.4))
    wall = splats([[0.0, 0.0, 2.5]], scales=1000.0, opacities=0.99)
    start = join(front, wall, cloud(400, 40, 30, degree=0, seed=1))
    left = sparser(trainer(tmp_path, start), start)
    kept = np.isin(start.means[:, 2], left.means[:, 2])
    assert kept[:101].mean() > 0.95  # some of these hide each other
    assert len(left) == 401  # a fifth of all is gone


def test_cut_out_views_are_compared_over_the_background_that_they_are_drawn_on(tmp_path):
    """Over black, as they are stored, their error on white would be large, and so would be what a
    round may cost."""
    start = cloud(300, 40, 30, degree=0)
    view = view_of("cut out", drawn(start), WHERE)
    alpha = np.rint(255 * render(start, WHERE, RasterSettings()).alpha).astype(np.uint8)
    levels = [
        replace(level, mask=alpha, outside=TRANSPARENT)
        for level in map(view.levels.__getitem__, (0, 1))
    ]
    views = [replace(view, levels=levels)] * 30
    white = replace(NEAR, background=1.0)
    on_white = sparser(trainer(tmp_path, start, views=views, draw=white), start)
    on_black = sparser(trainer(tmp_path, start, views=views), start)
    assert abs(len(on_white) - len(on_black)) <= 3


@pytest.mark.parametrize("share", [0.1, 0.5, 0.6, 0.9, 1.0])
def test_between_these_steps_nothing_is_removed(tmp_path, share):
    start = cloud(100, 40, 30, degree=0)
    left = sparser(trainer(tmp_path, start), start, share)
    assert len(left) == 100


def test_what_only_views_that_are_not_measured_show_stays(tmp_path, monkeypatch):
    """Two of ten views look at the other side, and none of the four that are measured."""
    monkeypatch.setattr(sparsification, "MAX_MEASURED_VIEWS", 4)
    back = cloud(60, 40, 30, degree=0, seed=5)
    back = replace(back, means=back.means * np.array([1, 1, -1], np.float32))
    start, behind = join(cloud(200, 40, 30, degree=0), back), camera(40, 30, matrix=HALF_TURN)
    measured = evenly_spaced(range(10), 4)
    others = [k for k in range(10) if k not in measured][:2]
    views = [
        view_of(f"{k}", noisy(drawn(start, where)), where)
        for k, where in ((k, behind if k in others else WHERE) for k in range(10))
    ]
    left = sparser(trainer(tmp_path, start, views=views), start)
    assert (left.means[:, 2] < 0).sum() == 60
    assert len(left) < 260


def test_what_few_of_the_measured_views_show_is_no_floater(tmp_path, monkeypatch):
    """A post before a wall, seen by three of ten views from a walk past it, and by one of four."""
    monkeypatch.setattr(sparsification, "MAX_MEASURED_VIEWS", 4)
    xs = np.arange(-1.0, 6.0, 0.25)
    colours = np.random.default_rng(0).uniform(0, 1, (len(xs) * 4, 3))
    places = [[x, y, 4.0] for x in xs for y in (-0.75, -0.25, 0.25, 0.75)]
    wall = splats(places, scales=(0.2, 0.2, 0.02), opacities=0.95, rgb=colours)
    places = [[2.4, y, 0.6] for y in np.linspace(-0.12, 0.12, 13)]
    start = join(wall, splats(places, scales=0.015, opacities=0.95))
    cameras = [camera(40, 30, matrix=moved(0.45 * k)) for k in range(10)]
    views = [view_of(f"{k}", noisy(drawn(start, c), 0.05), c) for k, c in enumerate(cameras)]
    left = sparser(trainer(tmp_path, start, views=views), start)
    assert (left.means[:, 2] < 1).sum() == 13


def test_splats_outside_the_bounds_stay(tmp_path):
    start = cloud(200, 40, 30, degree=0)
    middle = float(np.median(start.means[:, 0]))
    bounds = (-1e9, -1e9, middle, 1e9)
    density = BoundedDensity(AdaptiveDensity(3), bounds)
    left = sparser(trainer(tmp_path, start, bounds), start, SHARES[0], density)
    assert len(left) < 200
    assert (left.means[:, 0] >= middle).sum() == (start.means[:, 0] >= middle).sum()


def test_splats_that_are_not_finite_do_not_stop_it(tmp_path):
    start = cloud(100, 40, 30, degree=0)
    start.means[3] = np.nan
    left = sparser(trainer(tmp_path, start), start)
    assert np.isfinite(left.means).all()
    assert 79 < len(left) < 99


def test_one_splat_stays(tmp_path):
    start = cloud(1, 40, 30, degree=0)
    left = sparser(trainer(tmp_path, start), start)
    assert len(left) == 1
