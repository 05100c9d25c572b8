"""Splats in space that the seeds show to be free are removed."""

from dataclasses import replace

import numpy as np
import pytest

from stages.base.stage import Report
from stages.scene import DrawSettings, look_at
from stages.train import hooks
from stages.train.free_space import ENOUGH_VIEWS_PAST, MIN_VIEWS_PAST, known_free_space
from stages.train.hooks import FLOATER_REMOVALS
from stages.train.loop import train as train_all
from stages.train.optimiser import new_model
from stages.train.schedule import Schedule
from tests.scenes import camera, splats
from tests.train.pictures import trainer_of, view_of

FAR = 10.0  # a wall, before all cameras


def wall(z=FAR, width=8.0, n=41):
    at = np.linspace(-width, width, n)
    xs, ys = np.meshgrid(at, at)
    means = np.stack([xs.ravel(), ys.ravel(), np.full(n * n, z)], 1)
    return splats(means, scales=2 * width / n, opacities=0.1, rgb=(0.5, 0.5, 0.5))


def cameras(n):
    """Beside each other, a tenth of a unit apart, all of them before the wall."""
    straight = camera(64, 48)
    return [
        replace(straight, world_to_camera=look_at(np.array([x, 0, 0]), np.array([x, 0, 1.0])))
        for x in 0.1 * np.arange(n)
    ]


def held(means, n=2, start=None):
    space = known_free_space((wall() if start is None else start).means, cameras(n))
    return space.contains(np.array(means, np.float32).reshape(-1, 3)).tolist()


def test_positions_nearer_than_half_the_depth_of_the_wall_are_free():
    assert held([(0, 0, 4.8), (0, 0, 0.5), (0.5, -0.5, 3.0)]) == [True, True, True]


def test_positions_at_the_wall_or_little_before_it_or_behind_it_are_not_free():
    assert held([(0, 0, FAR), (0, 0, 0.6 * FAR), (0, 0, 2 * FAR)]) == [False, False, False]


def test_nothing_is_known_where_no_view_looks():
    assert held([(0, 0, -4.8), (50.0, 0, 4.8)]) == [False, False]
    assert held([(0, 0, 4.8)], n=0) == [False]
    assert held([], n=2) == []
    assert held([(np.nan, 0, 4.8), (0, 0, np.inf)]) == [False, False]


def test_nothing_is_known_where_there_are_no_seeds():
    aside = wall()
    aside.means[:, 0] += 100.0
    assert held([(0, 0, 4.8)], start=aside) == [False]
    assert held([(0, 0, 4.8)], start=wall().take(np.arange(0))) == [False]


@pytest.mark.parametrize("n", [ENOUGH_VIEWS_PAST, ENOUGH_VIEWS_PAST + 3])
def test_splats_that_many_views_confirm_are_kept_without_seeds(n):
    assert held([(0, 0, 4.8)], n=n) == [False]


def test_one_view_is_not_enough():
    assert held([(0, 0, 4.8)], n=1) == [False]
    assert held([(0, 0, 4.8)], n=MIN_VIEWS_PAST) == [True]


def test_a_surface_in_one_view_outweighs_free_space_in_others():
    post = np.concatenate([wall().means, np.array([[0.0, 0.0, 4.8]], np.float32)])
    beside, at_the_post = (2.0, 0.0, 4.8), (0.0, 0.0, 4.9)
    space = known_free_space(post, cameras(2))
    assert space.contains(np.array([beside, at_the_post])).tolist() == [True, False]


def test_depths_do_not_depend_on_the_size_of_the_views():
    for photograph in (camera(4000, 3000, focal=4000.0), camera(64, 48)):
        (depths,) = known_free_space(wall().means, [photograph]).depths
        assert depths.shape == (24, 32)
        np.testing.assert_allclose(depths, FAR)


def test_seeds_that_are_not_finite_are_left_out():
    start = wall()
    start.means[::7] = np.nan
    start.means[3] = np.inf
    assert held([(0, 0, 4.8), (0, 0, FAR)], start=start) == [True, False]


class Clouds:
    """A density rule that adds a floater in front of the cameras each time."""

    def __init__(self):
        self.made = 0

    def grow(self, model, budget, threshold):
        self.made += 1
        more = new_model(*(a[:1].copy() for a in model.arrays))
        more.means[:] = 0.0, 0.0, 3.0
        return model.joined(more)

    def inside(self, model):
        return np.ones(len(model), bool)


@pytest.mark.parametrize("steps", [1, 60, 403])
def test_no_floater_is_left_at_the_end_of_training(tmp_path, monkeypatch, steps):
    start = wall()
    pictures = np.full((48, 64, 3), 0.5, np.float32)
    views = [view_of(f"{k}", pictures, one) for k, one in enumerate(cameras(3))]
    schedule = Schedule(steps=steps, extent=10.0, sh_degree=0, n_start=len(start), seed=0)
    made = trainer_of(
        *(schedule, views, [], DrawSettings(near=0.1), 10_000, tmp_path, Report()), backend="cpu"
    )
    clouds = Clouds()
    monkeypatch.setattr(hooks, "AdaptiveDensity", lambda *_: clouds)
    model = train_all(made, start)
    assert clouds.made == sum(schedule.densifies_after(step) for step in range(steps))
    assert (model.means[:, 2] > 0.5 * FAR).all()
    # of a wall in one colour sparsification may remove a fifth four times
    assert len(model) > 0.4 * len(start)


def test_floaters_are_removed_a_few_times_in_a_run_and_at_its_end():
    for steps in (7, 3000, 30_000):
        schedule = Schedule(steps=steps, extent=1.0, sh_degree=0, n_start=1, seed=0)
        steps_with_removal = [
            step for step in range(steps) if schedule.passes(step + 1, FLOATER_REMOVALS)
        ]
        assert len(steps_with_removal) == min(steps, FLOATER_REMOVALS)
        assert steps_with_removal[-1] == steps - 1
