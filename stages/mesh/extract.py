"""Signed distance field -> mesh: marching cubes, removal of small components, simplification."""

from __future__ import annotations

import itertools

import fast_simplification
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from stages.mesh.fuse import Volume
from stages.scene.mesh import Mesh

SMALL_COMPONENT = 0.01  # share of the area; smaller connected components are removed


def extract_surface(volume: Volume) -> Mesh:
    """Marching cubes (Lewiner et al. 2003) on observed voxels only: at unobserved space the surface
    stays open instead of being closed around it."""
    from skimage.measure import marching_cubes

    try:
        # "descent": the distance grows outwards, so faces point outwards.
        vertices, faces, _, _ = marching_cubes(
            volume.distance,
            0.0,
            mask=_observed_cubes(volume.weight > 0),
            gradient_direction="descent",
        )
    except (ValueError, RuntimeError):  # raised by scikit-image where there is no surface
        return Mesh.empty()
    return Mesh.of(vertices * volume.voxel + volume.corner, faces)


def _observed_cubes(seen: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """[X, Y, Z] at the far corner of each cube, where scikit-image reads the mask: whether all
    corners were observed."""
    shape = np.array(seen.shape) - 1
    cubes = np.zeros(seen.shape, bool)
    inner = cubes[1:, 1:, 1:]
    inner[:] = True
    for corner in itertools.product((0, 1), repeat=3):
        inner &= seen[tuple(slice(c, c + n) for c, n in zip(corner, shape, strict=True))]
    return cubes


def remove_small_components(mesh: Mesh) -> tuple[Mesh, int]:
    """(the mesh, number of removed components): those of less than SMALL_COMPONENT of the
    area."""
    count = len(mesh.vertices)
    if not count:
        return mesh, 0
    a, b, c = mesh.faces.T
    ends = np.concatenate([a, b]), np.concatenate([b, c])
    links = coo_array((np.ones(len(ends[0]), bool), ends), shape=(count, count))
    components, component_of = connected_components(links, directed=False)
    areas = np.bincount(component_of[a], face_areas(mesh), components)
    kept = areas >= SMALL_COMPONENT * areas.sum()
    return Mesh.of(mesh.vertices, mesh.faces[kept[component_of[a]]]), int((~kept).sum())


def face_areas(mesh: Mesh) -> NDArray[np.float64]:
    """[F] areas in square world units."""
    a, b, c = (mesh.vertices[mesh.faces[:, i]].astype(np.float64) for i in range(3))
    return np.asarray(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1))


def simplify(mesh: Mesh, triangles: int) -> Mesh:
    """The mesh with at most about `triangles` triangles, by quadric error metrics (Garland &
    Heckbert, SIGGRAPH 1997). More are left where borders and holes need them."""
    if len(mesh.faces) <= triangles:
        return mesh
    # Normalised, because the library has absolute thresholds.
    low, size = mesh.vertices.min(axis=0), float(np.ptp(mesh.vertices, axis=0).max())
    vertices, faces = (mesh.vertices.astype(np.float64) - low) / size, mesh.faces
    while len(faces) > triangles:  # one pass ends early at borders and edges of several faces
        before = len(faces)
        vertices, faces = fast_simplification.simplify(vertices, faces, target_count=triangles)
        if len(faces) >= before:
            break
    return Mesh.of(vertices * size + low, faces)
