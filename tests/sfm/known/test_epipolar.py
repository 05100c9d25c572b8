"""Poses that fit, and poses that do not."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from stages.scene import look_at
from stages.sfm.known.epipolar import inlier_ratios, median_inlier_ratio, misfits, upside_down
from stages.sfm.known.triangulation import _posed_geometry
from stages.sfm.worker.job import KnownCameras

LENS = np.array([500.0, 520.0, 310.0, 250.0])
RANDOM = np.random.default_rng(3)
EYES = RANDOM.normal(size=(8, 3)) * (3, 1, 1) + (0, 0, -5)
POSES = np.array([look_at(eye, RANDOM.normal(size=3) * 0.3) for eye in EYES])
CLOUD = RANDOM.uniform(-1, 1, (200, 3))


def seen(pose: np.ndarray) -> np.ndarray:
    at = CLOUD @ pose[:3, :3].T + pose[:3, 3]
    return at[:, :2] / at[:, 2:] * LENS[:2] + LENS[2:]


PAIRS = [(i, j, seen(POSES[i]), seen(POSES[j])) for i in range(8) for j in range(i + 1, 8)]


def fits(poses: np.ndarray, shift_px: float = 0.0) -> float:
    moved = [(i, j, a, b + np.array([0.0, shift_px])) for i, j, a, b in PAIRS]
    found = median_inlier_ratio(moved, np.tile(LENS, (8, 1)), poses, 640.0)
    assert found is not None
    return found


def test_right_poses_fit_and_pixels_off_do_not() -> None:
    assert fits(POSES) == 1.0
    assert fits(POSES, shift_px=1.0) > 0.95
    assert fits(POSES, shift_px=12.0) < 0.3


def test_scale_and_origin_of_the_world_do_not_matter() -> None:
    moved = POSES @ np.linalg.inv(look_at(np.array([9.0, 5, 2]), np.zeros(3)))
    moved[:, :3, 3] *= 1000
    assert fits(moved) == 1.0


def test_without_pairs_there_is_no_ratio() -> None:
    assert median_inlier_ratio([], np.tile(LENS, (8, 1)), POSES, 640.0) is None
    here = np.tile(POSES[:1], (8, 1, 1))
    assert median_inlier_ratio(PAIRS, np.tile(LENS, (8, 1)), here, 640.0) is None


def test_matches_that_fit_the_poses_need_no_estimate_and_wrong_poses_are_not_believed() -> None:
    known = KnownCameras(np.tile(LENS, (8, 1)), POSES)
    matches = np.arange(len(CLOUD), dtype=np.uint32).repeat(2).reshape(-1, 2)
    first, second, a, b = PAIRS[0]
    wrong = np.arange(len(CLOUD)) < 60
    b = np.where(wrong[:, None], b[::-1], b)
    geometry = _posed_geometry(known, 640.0, (first, second), matches, a, b)
    assert geometry is not None
    kept = np.isin(np.arange(len(CLOUD)), geometry.inlier_matches[:, 0])
    assert kept[~wrong].all()
    assert kept[wrong].mean() < 0.3
    assert _posed_geometry(known, 640.0, (first, 7), matches, a, b) is None
    few = _posed_geometry(known, 640.0, (first, second), matches[:9], a[-9:], b[-9:])
    assert few is None


UPSIDE_DOWN = np.diag([-1.0, -1.0, 1.0, 1.0])
ELSEWHERE = look_at(np.array([0.0, 6.0, -1.0]), np.array([0.0, 0.0, -5.0]))


def wrong(poses: np.ndarray, turned: Sequence[int], elsewhere: Sequence[int] = ()) -> np.ndarray:
    poses = poses.copy()
    poses[list(turned)] = UPSIDE_DOWN @ poses[list(turned)]
    poses[list(elsewhere)] = ELSEWHERE @ poses[list(elsewhere)]
    return poses


def found(poses: np.ndarray, frames: Sequence[int] = range(8)) -> tuple[list[int], list[int]]:
    """(misfits, those that are upside down)."""
    lenses = np.tile(LENS, (8, 1))
    sizes = np.tile([620.0, 500.0], (8, 1))  # twice the principal point
    bad = misfits(PAIRS, inlier_ratios(PAIRS, lenses, poses, 640.0), frames)
    return bad, upside_down(PAIRS, lenses, poses, sizes, frames, bad)


@pytest.mark.parametrize("turned", [(), (2, 5), (0, 1, 6)])
def test_photographs_with_wrong_cameras_are_named_and_right_ones_are_not(
    turned: Sequence[int],
) -> None:
    assert found(wrong(POSES, turned)) == ([*turned], [*turned])


def test_a_camera_that_is_elsewhere_is_not_upside_down() -> None:
    assert found(wrong(POSES, [1], [6])) == ([1, 6], [1])


def test_right_cameras_are_not_named_though_most_of_their_pairs_are_with_wrong_ones() -> None:
    """View 7 has three of its four pairs with views that are wrong."""
    poses = wrong(POSES, (0, 1, 2))
    some = [pair for pair in PAIRS if pair[1] < 7 or pair[0] in (0, 1, 2, 3)]
    ratios = inlier_ratios(some, np.tile(LENS, (8, 1)), poses, 640.0)
    of_7 = [ratio for pair, ratio in zip(some, ratios, strict=True) if pair[1] == 7]
    assert np.median(of_7) < 0.1
    assert misfits(some, ratios, range(8)) == [0, 1, 2]


def test_the_faces_of_a_photograph_are_judged_together() -> None:
    frames = [0, 0, 0, 1, 2, 3, 4, 5]
    assert found(wrong(POSES, [2]), frames)[0] == []
    assert found(wrong(POSES, [0, 1, 2]), frames)[0] == [0]
