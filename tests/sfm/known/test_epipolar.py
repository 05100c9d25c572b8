"""Poses that fit, and poses that do not."""

from __future__ import annotations

import numpy as np

from stages.scene import look_at
from stages.sfm.known.epipolar import median_inlier_ratio
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
