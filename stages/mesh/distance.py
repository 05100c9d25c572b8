"""Distances of points from a mesh."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from stages.scene.mesh import Mesh

_CANDIDATES = 8  # triangles measured exactly for each point
_POINTS_AT_ONCE = 1 << 16


def distances_to_mesh(
    points: NDArray[np.floating], mesh: Mesh, spacing: float
) -> NDArray[np.float64]:
    """[P] distance from each point [P, 3] to the nearest triangle, world units; infinite for an
    empty mesh.

    The distance is exact for the triangles of the eight nearest surface samples, which are at most
    `spacing` apart. It is never too small, and too large only where all eight samples miss the
    nearest triangle.
    """
    if not len(mesh.faces):
        return np.full(len(points), np.inf)
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    samples, triangle = _samples(corners, spacing)
    tree = cKDTree(samples)
    count = min(_CANDIDATES, len(samples))
    result = np.empty(len(points))
    for start in range(0, len(points), _POINTS_AT_ONCE):
        part = np.asarray(points[start : start + _POINTS_AT_ONCE], np.float64)
        _, nearest = tree.query(part, k=range(1, count + 1), workers=-1)
        found = _to_triangles(
            np.repeat(part, count, axis=0), corners[triangle[nearest.ravel()]]
        ).reshape(-1, count)
        result[start : start + len(part)] = found.min(axis=1)
    return result


def _samples(
    corners: NDArray[np.float64], spacing: float
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """(samples [S, 3], the triangle of each [S]): each triangle is subdivided into n^2 similar ones
    with edges of at most `spacing`, and their centres are the samples."""
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    cuts = np.clip(np.ceil(edges / spacing), 1, 64).astype(np.int64)
    points, owners = [], []
    for n in np.unique(cuts):
        chosen = np.flatnonzero(cuts == n)
        i, j = (grid.ravel() for grid in np.mgrid[:n, :n])
        upright, turned = i + j < n, i + j < n - 1
        u = np.concatenate([i[upright] + 1 / 3, i[turned] + 2 / 3]) / n
        v = np.concatenate([j[upright] + 1 / 3, j[turned] + 2 / 3]) / n
        a, b, c = corners[chosen].transpose(1, 0, 2)[:, :, None]
        places = a + u[:, None] * (b - a) + v[:, None] * (c - a)
        points.append(places.reshape(-1, 3))
        owners.append(np.repeat(chosen, len(u)))
    return np.concatenate(points), np.concatenate(owners)


def _to_triangles(points: NDArray[np.float64], corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """[M] distance of each point [M, 3] from its triangle [M, 3, 3]: to the plane if the foot of
    the perpendicular lies inside, else to the nearest edge."""
    a, b, c = corners.transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    square = np.maximum((normal * normal).sum(axis=1), np.finfo(np.float64).tiny)
    best = np.full(len(points), np.inf)
    inside = np.ones(len(points), bool)
    for start, end in ((a, b), (b, c), (c, a)):
        along, off = end - start, points - start
        share = (off * along).sum(axis=1) / np.maximum((along * along).sum(axis=1), 1e-300)
        gap = off - np.clip(share, 0, 1)[:, None] * along
        best = np.minimum(best, np.linalg.norm(gap, axis=1))
        inside &= (np.cross(along, off) * normal).sum(axis=1) >= 0
    height = np.abs(((points - a) * normal).sum(axis=1)) / np.sqrt(square)
    return np.where(inside, height, best)
