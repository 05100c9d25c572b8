"""Where the sample's cameras truly are, and how to compare others with them."""

from __future__ import annotations

import cv2
import numpy as np

from tests.sfm.checks.bad_captures import SAMPLE

TRUTH = SAMPLE.parent / "truth.json"


def centres(poses: np.ndarray) -> np.ndarray:
    return -np.einsum("vij,vi->vj", poses[:, :3, :3], poses[:, :3, 3])


def similarity(source: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, float, np.ndarray]:
    """Rotation, scale, shift with target = scale R source + shift (Umeyama 1991)."""
    a, b = source - source.mean(axis=0), target - target.mean(axis=0)
    u, s, vt = np.linalg.svd(b.T @ a)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    turn = u @ np.diag(signs) @ vt
    scale = float((s * signs).sum() / (a**2).sum())
    return turn, scale, target.mean(axis=0) - scale * turn @ source.mean(axis=0)


def off_by(pose: np.ndarray, degrees: float, metres: float, r: np.random.Generator) -> np.ndarray:
    """A camera turned and moved by about as much, at random."""
    turn, _ = cv2.Rodrigues(np.radians(degrees) * r.normal(size=3) / np.sqrt(3))
    found = pose.copy()
    found[:3, :3] = turn @ pose[:3, :3]
    centre = -pose[:3, :3].T @ pose[:3, 3] + metres * r.normal(size=3) / np.sqrt(3)
    found[:3, 3] = -found[:3, :3] @ centre
    return found
