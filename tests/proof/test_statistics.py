"""Counts whose answers are known by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from stages.proof.statistics import Statistics, statistics_of
from stages.scene import Splats


def tidy(n: int = 500) -> Splats:
    """Round splats of 1 cm in a cube of about 2 m, all different; nothing is wrong with them."""
    rng = np.random.default_rng(2)
    return Splats(
        means=rng.uniform(-1, 1, (n, 3)).astype(np.float32),
        quaternions=np.tile(np.array([1, 0, 0, 0], np.float32), (n, 1)),
        log_scales=np.full((n, 3), np.log(0.01), np.float32),
        opacity_logits=np.zeros(n, np.float32),
        sh=rng.normal(0, 0.3, (n, 4, 3)).astype(np.float32),
        sh_degrees=(np.arange(n) % 2).astype(np.uint8),
    )


def troubles(statistics: Statistics) -> dict[str, int]:
    return {name: count for name, count in statistics.troubles.items() if count}


def test_nothing_is_wrong_with_a_tidy_scene() -> None:
    statistics = statistics_of(tidy())
    assert (statistics.count, statistics.whole, statistics.by_degree) == (
        500,
        500,
        {0: 250, 1: 250},
    )
    assert statistics.not_finite == {}
    assert troubles(statistics) == {}
    assert abs(statistics.median_scale - 0.01) < 1e-6
    assert statistics.median_opacity == 0.5


def test_each_kind_of_trouble_is_counted() -> None:
    splats = tidy()
    splats.log_scales[0] = np.log([1e-5, 2e-5, 0.003])  # 150 times as long as wide
    splats.log_scales[1] = np.log([1e-5, 0.01, 0.01])  # flat: no needle
    splats.log_scales[2] = np.log([1e-4, 1e-4, 0.0099])  # 99 times: not yet
    splats.log_scales[3] = np.log(0.9)  # large is no trouble: a wall of a room is
    splats.means[4] = (0, 0, 5.5)
    splats.means[5] = (0, 0, 4.5)  # 4.5 times as far out as the box: not yet
    splats.opacity_logits[6] = np.log(0.5 / 255)
    splats.quaternions[7] = 0
    splats.log_scales[8] = 60
    found = troubles(statistics_of(splats))
    assert found == {
        **dict.fromkeys(("needles", "outliers", "transparent", "no-rotation"), 1),
        "too-large": 1,
    }


def test_values_that_are_not_finite_are_named_and_left_out() -> None:
    splats = tidy()
    splats.means[0, 1] = np.nan
    splats.means[1] = np.inf
    splats.sh[1, 2, 0] = np.nan
    splats.opacity_logits[3] = -np.inf
    statistics = statistics_of(splats)
    assert statistics.not_finite == {"means": 2, "sh": 1, "opacity_logits": 1}
    assert (statistics.count, statistics.whole) == (500, 497)
    assert np.isfinite([statistics.low, statistics.high, statistics.median_centre]).all()
    assert troubles(statistics) == {}


def test_the_box_of_the_middle_does_not_follow_a_stray() -> None:
    splats = tidy()
    splats.means[0] = 1e6
    statistics = statistics_of(splats)
    assert statistics.high.max() == 1e6
    assert statistics.middle_high.max() < 1.1
    assert statistics.troubles["outliers"] == 1


def test_the_order_of_the_rows_does_not_matter() -> None:
    splats = tidy()
    splats.log_scales[:40, 0] += 6
    a, b = (
        statistics_of(splats),
        statistics_of(splats.take(np.random.default_rng(0).permutation(500))),
    )
    for name in Statistics.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


def test_a_scene_of_many_blocks_is_counted_whole() -> None:
    n = 70_000  # more than one block
    splats = replace(tidy(n), opacity_logits=np.full(n, -9, np.float32))
    assert statistics_of(splats).troubles["transparent"] == n


def test_nothing_has_nothing_in_it() -> None:
    statistics = statistics_of(tidy(0))
    assert (statistics.count, statistics.whole, statistics.by_degree) == (0, 0, {})
    alone = statistics_of(tidy(1))
    assert troubles(alone) == {}
