"""A sparse model whose every number is known."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stages.cameras.lens import Lens
from stages.scene import look_at
from stages.sfm.worker.sparse_model import SparseModel

FOCAL, K = 500.0, -0.05
SIZE = (640, 480)


def random_rotation(seed: int) -> NDArray[np.float64]:
    matrix = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    return matrix * np.linalg.det(matrix)


def orbit_model(views: int, points: int, seed: int = 0, radius: float = 4.0) -> SparseModel:
    """Cameras on half a circle that look at a cloud of points of radius 1; every camera sees
    every point, and observations are exact."""
    random = np.random.default_rng(seed)
    cloud = random.uniform(-0.7, 0.7, (points, 3))
    angles = np.linspace(0, np.pi, views)
    poses = np.array(
        [
            look_at(np.array([radius * np.sin(a), -1.0, -radius * np.cos(a)]), np.zeros(3))
            for a in angles
        ]
    )
    camera_points = np.einsum("vij,pj->pvi", poses[:, :3, :3], cloud) + poses[:, :3, 3]
    uv = camera_points[..., :2] / camera_points[..., 2:]
    px = FOCAL * Lens(radial=(K,)).distort(uv) + np.array(SIZE) / 2
    pairs = np.array([(i, i + 1) for i in range(views - 1)], np.int32)
    return SparseModel(
        names=tuple(f"{i:02d}.jpg" for i in range(views)),
        view_cameras=np.zeros(views, np.int32),
        view_frames=np.arange(views, dtype=np.int32),
        world_to_camera=poses,
        camera_sizes=np.array([SIZE], np.int32),
        camera_params=np.array([[FOCAL, SIZE[0] / 2, SIZE[1] / 2, K]]),
        focal_priors_px=np.array([FOCAL / 1.05]),
        points=cloud,
        colours=random.integers(0, 256, (points, 3)).astype(np.uint8),
        observed_points=np.repeat(np.arange(points), views).astype(np.int32),
        observing_views=np.tile(np.arange(views), points).astype(np.int32),
        observed_px=px.reshape(-1, 2),
        pairs=pairs,
        pair_inlier_ratios=np.ones(len(pairs)),
        pairs_turned=np.zeros(len(pairs), np.bool_),
        rotations_to_others_deg=np.empty(0),
    )
