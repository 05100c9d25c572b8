"""The last bundle adjustment is robust: outlier matches hardly move the cameras."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest

pycolmap = pytest.importorskip("pycolmap")


def test_outliers_hardly_move_robustly_adjusted_cameras() -> None:
    """Noise of 0.3 px, and one observation in twenty 8 px off in one direction: least squares, then
    the robust adjustment."""
    from stages.sfm.worker.mapping import _robust_bundle_adjustment

    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 1, 1, 8
    options.num_points3D = 300
    pycolmap.set_random_seed(1)
    true = pycolmap.synthesize_dataset(options)
    found = pycolmap.Reconstruction(true)
    r = np.random.default_rng(0)
    for image in found.images.values():
        for point in image.points2D:
            wrong = (8.0, 0.0) if r.random() < 0.05 else (0.0, 0.0)
            point.xy = point.xy + 0.3 * r.normal(size=2) + wrong
    plain = pycolmap.BundleAdjustmentOptions()
    plain.print_summary = False
    pycolmap.bundle_adjustment(found, plain)
    before = _rotation_error_deg(found, true)
    _robust_bundle_adjustment(found)
    assert _rotation_error_deg(found, true) < 0.7 * before


def _rotation_error_deg(found: Any, true: Any) -> float:
    """Mean difference, degrees, of the rotations from each photograph to the next."""
    turns = []
    for model in (found, true):
        matrices = [model.images[i].cam_from_world().rotation.matrix() for i in range(1, 9)]
        turns.append([b @ a.T for a, b in pairwise(matrices)])
    cosines = [(np.trace(a @ b.T) - 1) / 2 for a, b in zip(*turns, strict=True)]
    return float(np.degrees(np.arccos(np.clip(cosines, -1, 1))).mean())
