"""Where the sample's cameras truly are, and how to compare others with them."""

from __future__ import annotations

import numpy as np

from tests.structure.bad_captures import SAMPLE

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
