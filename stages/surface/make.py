"""Splats and their cameras -> a collision proxy, and how good it is."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.base.errors import Interrupted
from stages.base.stage import Report
from stages.raster.draw import raster_settings_of
from stages.scene import Reconstruction, Splats, split_held_out
from stages.surface import colour, depth_maps, extract, fuse
from stages.surface.depth_maps import DepthMap
from stages.surface.distance import distances
from stages.surface.mesh import Mesh

_WITHIN_VOXELS = 2.0  # how far a surface may lie from the mesh and count as covered
_SAMPLES = 200_000  # pixels that the covered share is measured on
_POOR_SHARE = 0.7


@dataclass(frozen=True)
class MadeMesh:
    """A mesh and its figures, JSON values. Lengths in world units.

    triangles, vertices, watertight, voxel, pieces_left_out.
    covered_share: of the pixels in which a training camera sees something solid, those whose
    surface (median depth) lies within two voxels of the mesh; what lies outside the box counts as
    not covered.
    sparse_points_inside_share: of the sparse points, those inside the box that was fused. Of these:
    sparse_median_distance, sparse_p90_distance to the nearest triangle, and the same as shares of
    the box's diagonal. None where there are no such points.
    """

    mesh: Mesh
    figures: dict[str, Any]


def make(
    splats: Splats, reconstruction: Reconstruction, triangles: int, backend: str, report: Report
) -> MadeMesh:
    """The mesh of what the training cameras see, of at most about `triangles` triangles.

    Equal inputs give an equal mesh, unless memory is so short that voxels have to be larger.
    Warnings: export-mesh-empty, export-mesh-coarse, export-mesh-gaps. Raises Interrupted.
    """
    training, _ = split_held_out(reconstruction.views)
    cameras = depth_maps.chosen([view.camera for view in training])
    settings = raster_settings_of(splats)

    def tick(number: int) -> None:
        if report.stop_requested.is_set():
            raise Interrupted(f"stopped after {number} of {len(cameras)} cameras")
        report.progress(number, len(cameras), "drawing depth")

    maps = depth_maps.draw(splats, cameras, settings, backend, tick)
    report.progress(len(cameras), len(cameras), "fusing depth")
    region = fuse.seen_region(maps)
    if region is None:
        return _nothing(report)
    voxels = fuse.voxels_that_fit()
    if voxels < fuse.VOXELS:
        report.warn(
            "export-mesh-coarse",
            f"Memory is short: the mesh was made of {voxels:,} voxels instead of "
            f"{fuse.VOXELS:,}. Close other programs and export again for a finer one.",
        )
    volume = fuse.fuse(maps, fuse.empty_volume(*region, voxels), settings.near)
    fine, crumbs = extract.without_crumbs(extract.surface_of(volume))
    mesh = extract.simplified(fine, triangles)
    if not len(mesh.faces):
        return _nothing(report)
    mesh = colour.coloured(mesh, maps, fuse.TRUNCATION * volume.voxel)
    mesh = replace(mesh, origin=splats.origin)
    covered = _covered(mesh, maps, volume.voxel)
    figures = {
        "triangles": len(mesh.faces),
        "vertices": len(mesh.vertices),
        "watertight": mesh.is_watertight,
        "voxel": _rounded(volume.voxel),
        "pieces_left_out": crumbs,
        "covered_share": covered,
        **_from_sparse_points(mesh, reconstruction.points, volume),
    }
    _warn_of_gaps(covered, report)
    return MadeMesh(mesh, figures)


def _nothing(report: Report) -> MadeMesh:
    report.warn(
        "export-mesh-empty",
        "The mesh is empty: no training camera sees a solid surface. Look at the splats with "
        "`splat view`.",
    )
    return MadeMesh(Mesh.empty(), {"triangles": 0, "vertices": 0, "covered_share": 0.0})


def _warn_of_gaps(covered: float, report: Report) -> None:
    if covered < _POOR_SHARE:
        report.warn(
            "export-mesh-gaps",
            f"The mesh covers only {covered:.0%} of what the training photographs show; the rest "
            "lies far away, or the splats disagree about where it is.",
        )


def _covered(mesh: Mesh, maps: list[DepthMap], voxel: float) -> float:
    """See MadeMesh."""
    pixels = sum(int((found.depth > 0).sum()) for found in maps)
    step = max(1, pixels // _SAMPLES)
    solid = [replace(found, vote=(found.depth > 0).astype(np.float32)) for found in maps]
    places = np.concatenate([found.points(step) for found in solid])
    near = distances(places, mesh, voxel) <= _WITHIN_VOXELS * voxel
    return round(float(near.mean()), 4)


def _from_sparse_points(
    mesh: Mesh, points: NDArray[np.float64], volume: fuse.Volume
) -> dict[str, float | None]:
    inside = np.all((points >= volume.corner) & (points <= volume.far_corner), axis=1)
    share = float(inside.mean()) if len(points) else 0.0
    figures: dict[str, float | None] = {"sparse_points_inside_share": round(share, 4)}
    found = distances(points[inside], mesh, volume.voxel)
    diagonal = float(np.linalg.norm(volume.far_corner - volume.corner))
    for name, percent in (("median", 50), ("p90", 90)):
        value = float(np.percentile(found, percent)) if len(found) else None
        figures[f"sparse_{name}_distance"] = _rounded(value)
        figures[f"sparse_{name}_distance_share"] = _rounded(value and value / diagonal)
    return figures


def _rounded(value: float | None) -> float | None:
    return None if value is None else float(f"{value:.4g}")
