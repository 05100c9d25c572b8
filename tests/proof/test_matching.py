"""Which row is which, whatever the order of a file."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stages.formats import splat32
from stages.proof.matching import extent_of, matched_rows
from stages.scene import Splats, morton
from tests.formats.truth import many_splats

N = 400


def shuffled(splats: Splats, seed: int = 3) -> tuple[Splats, np.ndarray]:
    rows = np.random.default_rng(seed).permutation(len(splats))
    return splats.take(rows), rows


def test_rows_in_their_own_order_are_themselves() -> None:
    splats = many_splats(N)
    np.testing.assert_array_equal(matched_rows(splats, splats, ()), np.arange(N))


@pytest.mark.parametrize("order", [morton.morton_order, splat32.order])
def test_a_known_order_is_found(order: object) -> None:
    splats = many_splats(N)
    rows = order(splats)  # type: ignore[operator]
    np.testing.assert_array_equal(matched_rows(splats, splats.take(rows), [rows]), rows)


def test_an_unknown_order_is_found() -> None:
    splats = many_splats(N)
    file, rows = shuffled(splats)
    np.testing.assert_array_equal(matched_rows(splats, file, [morton.morton_order(splats)]), rows)


def test_an_unknown_order_is_found_though_all_positions_moved_a_little() -> None:
    splats = many_splats(N)
    file, rows = shuffled(splats)
    noise = np.random.default_rng(4).normal(0, 3e-4 * extent_of(splats), file.means.shape)
    moved = replace(file, means=(file.means + noise).astype(np.float32))
    np.testing.assert_array_equal(matched_rows(splats, moved, ()), rows)


def test_splats_at_one_place_are_distinguished_by_their_values() -> None:
    splats = many_splats(N)
    splats = replace(splats, means=np.repeat(splats.means[: N // 4], 4, axis=0))
    file, rows = shuffled(splats)
    np.testing.assert_array_equal(matched_rows(splats, file, ()), rows)


def test_a_few_rows_that_changed_places_are_found_among_themselves() -> None:
    splats = many_splats(N)
    rows = np.arange(N)
    rows[[5, 90, 200]] = [200, 5, 90]
    np.testing.assert_array_equal(matched_rows(splats, splats.take(rows), ()), rows)


@pytest.mark.parametrize("far", [0.001, 5.0])
def test_a_splat_that_was_moved_is_still_itself(far: float) -> None:
    splats = many_splats(N)
    means = splats.means.copy()
    means[17] += far
    np.testing.assert_array_equal(
        matched_rows(splats, replace(splats, means=means), ()), np.arange(N)
    )


@pytest.mark.parametrize("moved", [0.03, 0.5, 0.9])
@pytest.mark.parametrize("order", [None, morton.morton_order])
def test_rows_whose_position_moved_keep_the_order_of_the_format(
    moved: float, order: object
) -> None:
    """As where a format has no room for them, and moves them onto the border of its range."""
    splats = many_splats(4 * N)
    rows = np.arange(4 * N) if order is None else order(splats)  # type: ignore[operator]
    border = np.quantile(np.abs(splats.means).max(axis=1), 1 - moved)
    file = splats.take(rows)
    factors = np.minimum(1, border / np.abs(file.means).max(axis=1, keepdims=True))
    file = replace(file, means=(file.means * factors).astype(np.float32))
    np.testing.assert_array_equal(matched_rows(splats, file, [rows]), rows)


@pytest.mark.parametrize("count", [0, 1, 2])
def test_few_rows_are_matched(count: int) -> None:
    splats = many_splats(N).take(np.arange(count))
    rows = np.arange(count)[::-1]
    np.testing.assert_array_equal(matched_rows(splats, splats.take(rows), ()), rows)


@pytest.mark.parametrize("what", ["all at one place", "elsewhere", "all alike"])
def test_every_row_is_used_once_even_where_nothing_fits(what: str) -> None:
    splats = many_splats(N)
    if what == "all at one place":
        file = replace(splats, means=np.ones_like(splats.means))
    elif what == "elsewhere":
        file = many_splats(N, seed=9)
    else:
        splats = splats.take(np.zeros(N, int))
        file = replace(splats, opacity_logits=splats.opacity_logits + 9, sh=splats.sh + 1)
    assert sorted(matched_rows(splats, file, ())) == list(range(N))
