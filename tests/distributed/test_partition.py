"""Where a scene is cut, who sees which block, and what each block gives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stages.distributed import merge, partition
from stages.evaluate.evaluation import EvaluationView
from stages.raster.backends import AUTO
from stages.scene import Camera, look_at
from tests import scenes
from tests.small_scene import small_scene


def places(n: int = 101) -> np.ndarray:
    return np.random.default_rng(3).normal(0, (5, 2), (n, 2))


@pytest.mark.parametrize("blocks", [2, 3, 4, 7])
def test_blocks_hold_about_equal_photographs(blocks: int) -> None:
    at, weights = places(2000), np.random.default_rng(2).uniform(0, 1, 2000)
    cells = partition.partition(at, weights, blocks)
    found = [weights[cell.holds(np.insert(at, 1, 0.0, axis=1))].sum() for cell in cells]
    assert len(found) == blocks
    assert np.isclose(sum(found), weights.sum())
    assert max(found) - min(found) < 0.01 * sum(found)


def test_every_point_lies_in_one_cell() -> None:
    cells = partition.partition(places(), np.ones(101), 5)
    points = np.random.default_rng(1).normal(0, 1000, (500, 3))
    lines = [value for cell in cells for value in (*cell.low, *cell.high) if abs(value) < 1e29]
    points[: len(lines), 0] = points[: len(lines), 2] = lines  # on the borders too
    assert (np.sum([cell.holds(points) for cell in cells], axis=0) == 1).all()


def test_each_photograph_counts_as_much_as_any_other(tmp_path) -> None:
    """However many points it shows."""
    scene = small_scene(tmp_path, views=6).reconstruction
    points = np.random.default_rng(4).normal(0, 0.4, (300, 3))
    _, weights = partition.weighted_points(replace(scene, points=points))
    assert np.isclose(weights.sum(), 6.0)


def test_photographs_that_look_at_one_spot_are_one_block() -> None:
    assert partition.partition(np.ones((20, 2)), np.ones(20), 4) == [partition.EVERYWHERE]


def test_a_photograph_teaches_what_it_shows_and_not_what_is_hidden(tmp_path) -> None:
    """A wall of splats hides the block behind it."""
    scene = small_scene(tmp_path, views=2)
    rng = np.random.default_rng(5)
    wall = scene.splats.take(slice(0, 200))
    wall = replace(
        wall,
        means=np.column_stack([np.full(200, -1.0), rng.uniform(-1, 1, (200, 2))]).astype("f4"),
        log_scales=np.full((200, 3), -1.5, np.float32),
        opacity_logits=np.full(200, 6.0, np.float32),
    )
    behind = replace(wall, means=(wall.means + np.array([2, 0, 0])).astype("f4"))
    lines = (np.array([-2.0, 0.0]), np.array([0.0, 2.0]))
    halves = [partition.Cell((low, -9.0), (high, 9.0)) for low, high in lines]
    both, _ = merge.merge_blocks([wall, behind], halves, wall.draw_settings)
    cells = partition.partition(np.array([[-1.0, 0.0], [1.0, 0.0]]), np.ones(2), 2)
    eye = Camera(72, 54, 160.0, 160.0, 36.0, 27.0, look_at(np.array([-4.0, 0, 0]), np.zeros(3)))
    share = partition.block_fractions(both, cells, [eye], AUTO)
    assert share[0, 0] > 0.9
    assert partition.assign_views(share)[:, 0].tolist() == [True, False]


def test_each_photograph_teaches_one_block_at_least() -> None:
    share = np.array([[0.06, 0.5, 0.0], [0.04, 0.5, 0.0]])
    member = partition.assign_views(share)
    assert member.tolist() == [[True, True, False], [False, True, False]]
    assert partition.crosses_blocks(member).tolist() == [False, True, False]


def test_merged_blocks_give_each_place_once_and_in_order(tmp_path) -> None:
    splats = small_scene(tmp_path, views=2).splats
    cells = partition.partition(splats.means[:, [0, 2]].astype(np.float64), np.ones(len(splats)), 3)
    whole, counts = merge.merge_blocks([splats] * 3, cells, splats.draw_settings)
    assert sum(counts) == len(splats)
    assert sorted(map(tuple, whole.means)) == sorted(map(tuple, splats.means))
    ends = np.cumsum([0, *counts])
    for cell, start, end in zip(cells, ends, ends[1:], strict=False):
        assert cell.holds(whole.means[start:end]).all()


def test_seams_are_where_a_splat_reaches_over_its_border(tmp_path) -> None:
    splats = small_scene(tmp_path, views=2).splats.take(slice(0, 3))
    means = np.array([[-0.1, 0, 0], [-3, 0, 0], [3, 0, 0]], np.float32)
    sizes = np.log(np.array([[0.05] * 3, [0.05] * 3, [0.05, 2.0, 0.05]], np.float32))
    splats = replace(splats, means=means, log_scales=sizes)
    cells = partition.partition(np.array([[-1.0, 0.0], [1.0, 0.0]]), np.ones(2), 2)
    assert merge.at_seams(splats, [2, 1], cells).tolist() == [True, False, True]


def test_a_block_with_too_many_splats_gives_those_that_its_photographs_show() -> None:
    """What hides behind a wall stays behind; what is another block's is given in any case by it."""
    wall = scenes.splats(
        [(x / 8, y / 8, 2.0) for x in range(-6, 7) for y in range(-5, 6)], 0.1, 0.95
    )
    hidden = scenes.splats([(x / 8, 0.1, 3.0) for x in range(-6, 7)], 0.05, 0.9)
    both = scenes.join(hidden, wall)
    seen = [EvaluationView("a", scenes.camera(), np.zeros((48, 64, 3), np.uint8))]
    own = np.ones(len(both), bool)
    own[-3:] = False
    found = merge.most_visible(both, own, len(wall) - 3, seen, AUTO)
    assert not found[: len(hidden)].any()
    assert (found[len(hidden) :] == own[len(hidden) :]).all()
