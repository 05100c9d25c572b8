"""Densification and culling during training, and the schedule."""

import numpy as np
import pytest

from stages.base.memory import training_mib
from stages.scene import logit
from stages.train.cap import splat_cap
from stages.train.density import (
    CHILD_LENGTH,
    CHILD_OFFSET,
    CHILD_OPACITY,
    CHILD_WIDTH,
    GRADIENT_THRESHOLD,
    AdaptiveDensity,
    cull,
    gradient_threshold,
    split_along_longest_axis,
)
from stages.train.optimiser import LearningRates, new_model
from stages.train.schedule import FULL, Schedule

VIEWS = 8


def model(n, scale=0.01, opacity=0.5):
    r = np.random.default_rng(0)
    return new_model(
        r.normal(size=(n, 3)).astype(np.float32),
        np.tile(np.array([1, 0, 0, 0], np.float32), (n, 1)),
        np.full((n, 3), np.log(scale), np.float32),
        np.full(n, logit(opacity), np.float32),
        r.normal(size=(n, 4, 3)).astype(np.float32),
    )


def with_gradients(m, rows, by=1.0):
    m.gradient_sum[rows] = by
    m.gradient_count[rows] = 1
    return m


def grow(m, cap=10**6):
    return AdaptiveDensity(VIEWS).grow(m, cap)


def centres_of_parents(grown, splits):
    """[splits, 3] the centres of the splats that the last rows replace."""
    return grown.means[len(grown) - 2 * splits :].reshape(splits, 2, 3).mean(1)


def test_splats_with_large_gradients_are_replaced_by_two_on_their_longest_axis():
    m = with_gradients(model(10), [2, 5])
    m.log_scales[5] = np.log([0.1, 0.4, 0.2])
    m.quaternions[5] = [np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)]  # a quarter turn: y becomes -x
    grown = grow(m)
    assert len(grown) == 12
    children = grown.take(np.arange(10, 12))
    offset = CHILD_OFFSET * 0.4
    np.testing.assert_allclose(children.means[:, 0] - m.means[5, 0], [-offset, offset], rtol=1e-5)
    np.testing.assert_allclose(children.means[:, 1:], m.means[[5, 5], 1:], atol=1e-6)
    scales = np.array([0.1 * CHILD_WIDTH, 0.4 * CHILD_LENGTH, 0.2 * CHILD_WIDTH])
    np.testing.assert_allclose(np.exp(children.log_scales), np.tile(scales, (2, 1)), rtol=1e-5)
    assert not children.moment1.any()
    assert not children.steps.any()


def test_two_children_together_look_like_their_parent():
    sigma = np.linspace(-3, 3, 61)
    parent = 0.5 * np.exp(-0.5 * sigma**2)
    m = with_gradients(model(1, scale=1.0, opacity=0.5), [0])
    children = split_along_longest_axis(m)
    centres = children.means[:, 0] - m.means[0, 0]
    opacity = 1 / (1 + np.exp(-children.opacity_logits))
    scale = np.exp(children.log_scales[:, 0])
    alphas = opacity[:, None] * np.exp(-0.5 * ((sigma - centres[:, None]) / scale[:, None]) ** 2)
    together = 1 - (1 - alphas).prod(0)
    assert np.abs(together - parent).max() < 0.08
    twice = 1 - (1 - parent) ** 2  # two copies of it, as published for small splats
    assert np.abs(twice - parent).max() > 0.2


@pytest.mark.parametrize("opacity", [0.005, 0.5, 0.999, 1 - 1e-7])
def test_the_opacity_of_children_is_a_share_of_their_parents(opacity):
    parent = with_gradients(model(1, opacity=opacity), [0])
    child = split_along_longest_axis(parent).opacity_logits[0]
    assert 1 / (1 + np.exp(-float(child))) == pytest.approx(CHILD_OPACITY * opacity, rel=1e-5)


def test_faint_and_broken_splats_go_and_large_ones_stay():
    m = model(10)
    m.opacity_logits[0] = logit(0.004)
    m.log_scales[1] = np.log(1e3)  # the wall of a hall: large in the world, not in a picture
    m.means[2, 1] = np.nan
    kept = cull(m)
    assert len(kept) == 8
    assert kept.log_scales.max() == m.log_scales[1, 0]


@pytest.mark.parametrize("room", [0, 1, 3])
def test_the_budget_is_kept_and_the_largest_gradients_come_first(room):
    m = with_gradients(model(10), range(10))
    m.gradient_sum[:] = np.arange(10) + 1.0
    grown = grow(m, cap=10 + room)
    assert len(grown) == 10 + room
    np.testing.assert_allclose(centres_of_parents(grown, room), m.means[10 - room :], atol=1e-6)


def test_splats_that_one_view_sees_are_densified_last_even_with_larger_gradients():
    m = with_gradients(model(3), range(3))
    m.gradient_count[:] = [1, 30, 60]  # of 60 steps: about 1, 4 and 8 of the 8 photographs
    m.gradient_sum[:] = m.gradient_count * np.array([3.0, 1.0, 1.1], np.float32)
    np.testing.assert_allclose(centres_of_parents(grow(m, cap=4), 1), m.means[2:], atol=1e-6)
    np.testing.assert_allclose(centres_of_parents(grow(m, cap=5), 2), m.means[1:], atol=1e-6)
    assert len(grow(m)) == 6  # while there is room, all do


def test_the_threshold_is_the_published_one_and_falls_with_the_root_of_a_long_runs_steps():
    assert {gradient_threshold(steps) for steps in (1, 2000, 2400)} == {GRADIENT_THRESHOLD}
    assert gradient_threshold(9600) == pytest.approx(GRADIENT_THRESHOLD / 2)


def test_the_cap_takes_half_of_the_free_memory():
    assert splat_cap(8192.0) == pytest.approx(4096 / training_mib(1), rel=1e-3)
    assert splat_cap(1.0) == 10_000


def schedule(steps):
    return Schedule(steps=steps, extent=2.0, sh_degree=3, n_start=100, seed=3)


@pytest.mark.parametrize("steps", [1, 10, 1500, 30_000])
def test_the_schedule_scales_to_any_number_of_steps(steps):
    s = schedule(steps)
    first, last = s.rates(0), s.rates(steps)
    assert 3.2e-4 <= first.means <= 6.1 * 3.2e-4
    assert 0.039 * first.means <= last.means <= 0.25 * first.means
    assert last.sh_dc < 0.41 * first.sh_dc
    assert s.active_sh_degree(0) == 0
    assert s.active_sh_degree(steps) == 3
    growing = [step for step in range(steps) if s.densifies_after(step)]
    assert all(step + 1 <= steps * 0.7 for step in growing)
    if steps >= 1500:
        assert len(growing) >= 10
    seen = [s.view(step, 7) for step in range(min(steps, 70))]
    if steps >= 70:
        assert all(sorted(seen[k : k + 7]) == list(range(7)) for k in range(0, 70, 7))
        assert seen[:7] != seen[7:14]


@pytest.mark.parametrize("steps", [200, 2000, 30_000])
def test_splats_are_added_only_while_pictures_have_the_full_size(steps):
    s = schedule(steps)
    growing = [step for step in range(steps) if s.densifies_after(step)]
    assert growing
    assert {s.level(step + 1) for step in growing[:-1]} == {FULL}
    budgets = [s.budget(step, 1000) for step in range(steps)]
    assert set(budgets[: steps // 5]) == {s.n_start}
    assert budgets == sorted(budgets)
    assert budgets[steps // 2] == budgets[-1] == 1000


def test_short_runs_raise_all_rates_and_that_of_the_means_at_the_end_most():
    published, short = schedule(30_000), schedule(3000)
    for name in ("means", "quaternions", "log_scales", "opacity_logits", "sh_dc", "sh_rest"):
        rate, former = (getattr(s.rates(0), name) for s in (short, published))
        assert rate == pytest.approx(10**0.6 * former)
    last, former = short.rates(3000).means, published.rates(30_000).means
    assert last == pytest.approx(10**1.2 * former)


def test_the_full_schedule_has_its_published_events():
    s = schedule(30_000)
    assert s.rates(0) == LearningRates(means=1.6e-4 * 2.0, extent=2.0)
    assert s.rates(30_000).means == pytest.approx(4 * 1.6e-6 * 2.0)  # the end is averaged
    assert s.active_sh_degree(999) == 0
    assert s.active_sh_degree(1000) == 1
    assert s.densifies_after(6099)
    assert not s.densifies_after(6050)
