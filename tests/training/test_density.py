"""Densification and pruning during training, and the schedule."""

import numpy as np
import pytest

from stages.scene import logit
from stages.training.cap import BYTES_PER_SPLAT, splat_cap
from stages.training.density import AdaptiveDensity
from stages.training.optimiser import new_model
from stages.training.schedule import Schedule

EXTENT = 10.0
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
    return AdaptiveDensity(EXTENT, VIEWS).grow(m, cap, np.random.default_rng(0))


def test_small_splats_with_large_gradients_are_cloned():
    m = with_gradients(model(10), [2, 5])
    grown = grow(m)
    assert len(grown) == 12
    np.testing.assert_array_equal(grown.means[10:], m.means[[2, 5]])
    assert not grown.moment1[10:].any()


def test_large_splats_with_large_gradients_are_split_into_two():
    m = with_gradients(model(10, scale=0.2), [3])
    grown = grow(m)
    assert len(grown) == 11
    np.testing.assert_allclose(np.exp(grown.log_scales[9:]), 0.2 / 1.6, rtol=1e-5)
    assert np.linalg.norm(grown.means[9:] - m.means[3], axis=1).max() < 5 * 0.2
    assert not (grown.means[9] == grown.means[10]).any()


def test_faint_giant_and_broken_splats_go():
    m = model(10)
    m.opacity_logits[0] = logit(0.004)
    m.log_scales[1] = np.log(0.11 * EXTENT)
    m.means[2, 1] = np.nan
    assert len(AdaptiveDensity(EXTENT, VIEWS).prune(m, remove_giants=True)) == 7
    assert len(AdaptiveDensity(EXTENT, VIEWS).prune(m, remove_giants=False)) == 8


@pytest.mark.parametrize("room", [0, 1, 3])
def test_the_budget_is_kept_and_the_largest_gradients_come_first(room):
    m = with_gradients(model(10), range(10))
    m.gradient_sum[:] = np.arange(10) + 1.0
    grown = grow(m, cap=10 + room)
    assert len(grown) == 10 + room
    if room:
        np.testing.assert_array_equal(grown.means[10:], m.means[10 - room :])


def test_splats_that_one_view_sees_are_densified_last_even_with_larger_gradients():
    m = with_gradients(model(3), range(3))
    m.gradient_count[:] = [1, 30, 60]  # of 60 steps: about 1, 4 and 8 of the 8 photographs
    m.gradient_sum[:] = m.gradient_count * np.array([3.0, 1.0, 1.1], np.float32)
    np.testing.assert_array_equal(grow(m, cap=4).means[3], m.means[2])
    np.testing.assert_array_equal(grow(m, cap=5).means[3:], m.means[1:])
    assert len(grow(m)) == 6  # while there is room, all do


def test_the_cap_takes_half_of_the_free_memory():
    assert splat_cap(8192.0) == pytest.approx(4096 * 1024 * 1024 / BYTES_PER_SPLAT, rel=1e-3)
    assert splat_cap(1.0) == 10_000


def schedule(steps):
    return Schedule(steps=steps, extent=2.0, sh_degree=3, n_start=100, seed=3)


@pytest.mark.parametrize("steps", [1, 10, 1500, 30_000])
def test_the_schedule_scales_to_any_number_of_steps(steps):
    s = schedule(steps)
    assert 3.2e-4 <= s.means_lr(0) <= 6 * 3.2e-4
    if steps > 1:
        assert s.means_lr(steps) == pytest.approx(0.01 * s.means_lr(0))
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


def test_the_full_schedule_has_its_published_events():
    s = schedule(30_000)
    assert s.means_lr(0) == pytest.approx(1.6e-4 * 2.0)
    assert s.rate_factor(0) == 1.0
    assert s.active_sh_degree(999) == 0
    assert s.active_sh_degree(1000) == 1
    assert s.densifies_after(499)
    assert s.densifies_after(599)
    assert not s.densifies_after(550)
    assert not s.densifies_after(399)
