"""Signed distance field -> triangles, without crumbs, and no more of them than asked for."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from stages.surface.fuse import Volume
from stages.surface.mesh import Mesh

SMALL_COMPONENT = 0.01  # of the whole area; smaller pieces that hang on nothing are left out


def extract_surface(volume: Volume) -> Mesh:
    """Marching cubes (Lewiner et al. 2003) between observed voxels only: where the unseen begins
    the surface ends, open, instead of closing around it."""
    from skimage.measure import marching_cubes

    try:
        # "descent" of the objects' density: outside is larger here, so faces turn to the outside.
        vertices, faces, _, _ = marching_cubes(
            volume.distance,
            0.0,
            mask=_observed_cubes(volume.weight > 0),
            gradient_direction="descent",
        )
    except (ValueError, RuntimeError):  # how scikit-image says that there is no surface
        return Mesh.empty()
    return Mesh.of(vertices * volume.voxel + volume.corner, faces)


def _observed_cubes(seen: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """[X, Y, Z] at each cube's far corner, where scikit-image looks: all its corners were seen."""
    shape = np.array(seen.shape) - 1
    cubes = np.zeros(seen.shape, bool)
    inner = cubes[1:, 1:, 1:]
    inner[:] = True
    for corner in itertools.product((0, 1), repeat=3):
        inner &= seen[tuple(slice(c, c + n) for c, n in zip(corner, shape, strict=True))]
    return cubes


def remove_small_components(mesh: Mesh) -> tuple[Mesh, int]:
    """(the mesh, number of pieces left out): those of less than CRUMB of the area."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    count = len(mesh.vertices)
    if not count:
        return mesh, 0
    a, b, c = mesh.faces.T
    ends = np.concatenate([a, b]), np.concatenate([b, c])
    links = coo_array((np.ones(len(ends[0]), bool), ends), shape=(count, count))
    pieces, piece_of = connected_components(links, directed=False)
    areas = np.bincount(piece_of[a], face_areas(mesh), pieces)
    kept = areas >= SMALL_COMPONENT * areas.sum()
    return Mesh.of(mesh.vertices, mesh.faces[kept[piece_of[a]]]), int((~kept).sum())


def face_areas(mesh: Mesh) -> NDArray[np.float64]:
    """[F] in square world units."""
    a, b, c = (mesh.vertices[mesh.faces[:, i]].astype(np.float64) for i in range(3))
    return np.asarray(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1))


def simplify(mesh: Mesh, triangles: int) -> Mesh:
    """At most about `triangles` of them, by quadric error (Garland & Heckbert, SIGGRAPH 1997)."""
    from fast_simplification import simplify

    if len(mesh.faces) <= triangles:
        return mesh
    # In the mesh's own units its thresholds mean something else for every scene.
    low, size = mesh.vertices.min(axis=0), float(np.ptp(mesh.vertices, axis=0).max())
    unit = (mesh.vertices.astype(np.float64) - low) / size
    vertices, faces = simplify(unit, mesh.faces, target_count=triangles)
    return Mesh.of(vertices * size + low, faces)
