"""Splats and their cameras -> the collision mesh and its quality figures."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from stages.base.errors import Interrupted
from stages.base.stage import Report
from stages.mesh import depth_maps, extract, fuse
from stages.mesh.depth_maps import DepthMap
from stages.mesh.vertex_colours import colour_vertices
from stages.raster.draw import raster_settings_of
from stages.scene import Reconstruction, Splats, split_held_out
from stages.scene.mesh import Mesh

_COVERED_VOXELS = 2.0  # largest distance of a covered surface from the mesh
_SAMPLES = 200_000  # pixels that the covered share is measured on
_SAMPLES_PER_VOXEL = 4  # random points of the mesh for each face of a voxel that it fills
_LOW_COVERAGE = 0.7
_MANY = 1.05  # times the wanted number of triangles, which is meant to be about that


@dataclass(frozen=True)
class CollisionMesh:
    """A mesh and its figures, JSON values. Lengths are in world units.

    triangles, vertices, watertight, voxel, removed_components.
    covered_share: of the pixels with depth in the training cameras, the share whose surface (median
    depth) lies within two voxels of the mesh. Surfaces outside the fused box are not covered.
    """

    mesh: Mesh
    figures: dict[str, Any]


def make_collision_mesh(
    splats: Splats, reconstruction: Reconstruction, triangles: int, backend: str, report: Report
) -> CollisionMesh:
    """The mesh of what the training cameras see, with at most about `triangles` triangles.

    Equal inputs give an equal mesh, unless a lack of memory enlarges the voxels.
    Warnings: export-mesh-empty, export-mesh-coarse, export-mesh-gaps, export-mesh-triangles.
    Raises Interrupted.
    """
    training, _ = split_held_out(reconstruction.views)
    cameras = depth_maps.select_cameras([view.camera for view in training])

    def tick(number: int) -> None:
        if report.stop_requested.is_set():
            raise Interrupted(f"stopped after {number} of {len(cameras)} cameras")
        report.progress(number, len(cameras), "drawing depth")

    maps = depth_maps.draw_depth_maps(splats, cameras, backend, tick)
    report.progress(len(cameras), len(cameras), "fusing depth")
    region = fuse.observed_box(maps)
    if region is None:
        return _empty_mesh(report)
    voxels = fuse.voxel_budget()
    if voxels < fuse.VOXELS:
        report.warn(
            "export-mesh-coarse",
            f"Memory is short: the mesh was made of {voxels:,} voxels instead of "
            f"{fuse.VOXELS:,}. Close other programs and export again for a finer one.",
        )
    near = raster_settings_of(splats).near
    volume = fuse.fuse_depth_maps(maps, fuse.empty_volume(*region, voxels), near)
    fine, removed = extract.remove_small_components(extract.extract_surface(volume))
    mesh = extract.simplify(fine, triangles)
    if not len(mesh.faces):
        return _empty_mesh(report)
    mesh = colour_vertices(mesh, maps, fuse.TRUNCATION * volume.voxel)
    mesh = replace(mesh, origin=splats.origin, place=splats.place)
    covered = _covered(mesh, maps, volume.voxel)
    figures = {
        "triangles": len(mesh.faces),
        "vertices": len(mesh.vertices),
        "watertight": mesh.is_watertight,
        "voxel": float(f"{volume.voxel:.4g}"),
        "removed_components": removed,
        "covered_share": covered,
    }
    _warn_of_gaps(covered, report)
    _warn_of_many(len(mesh.faces), triangles, report)
    return CollisionMesh(mesh, figures)


def _empty_mesh(report: Report) -> CollisionMesh:
    report.warn(
        "export-mesh-empty",
        "The mesh is empty: no training camera sees a solid surface. Look at the splats with "
        "`splat view`.",
    )
    return CollisionMesh(Mesh.empty(), {"triangles": 0, "vertices": 0, "covered_share": 0.0})


def _warn_of_gaps(covered: float, report: Report) -> None:
    if covered < _LOW_COVERAGE:
        report.warn(
            "export-mesh-gaps",
            f"The mesh covers only {covered:.0%} of what the training photographs show; the rest "
            "is far away, or its depth differs between cameras.",
        )


def _warn_of_many(count: int, wanted: int, report: Report) -> None:
    if count > _MANY * wanted:
        report.warn(
            "export-mesh-triangles",
            f"The mesh has {count:,} triangles instead of {wanted:,}: its borders and holes need "
            "them.",
        )


def _covered(mesh: Mesh, maps: list[DepthMap], voxel: float) -> float:
    """`covered_share` of CollisionMesh."""
    pixels = sum(int((drawn.depth > 0).sum()) for drawn in maps)
    step = max(1, pixels // _SAMPLES)
    solid = [replace(drawn, weight=(drawn.depth > 0).astype(np.float32)) for drawn in maps]
    places = np.concatenate([drawn.points(step) for drawn in solid])
    on_mesh = _surface_samples(mesh, voxel)
    near = cKDTree(on_mesh).query(places, distance_upper_bound=_COVERED_VOXELS * voxel)[0] < np.inf
    return round(float(near.mean()), 4)


def _surface_samples(mesh: Mesh, voxel: float) -> NDArray[np.float64]:
    """[S, 3] random points of the mesh, evenly by area: nearly always one within half a voxel."""
    counts = np.ceil(_SAMPLES_PER_VOXEL * extract.face_areas(mesh) / voxel**2).astype(np.int64)
    corners = mesh.vertices[np.repeat(mesh.faces, counts, axis=0)].astype(np.float64)
    weights = np.random.default_rng(0).dirichlet((1.0, 1.0, 1.0), len(corners))
    return np.asarray(np.einsum("sk,skd->sd", weights, corners))
