"""Points for known cameras: from their file, or triangulated from matches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stages.base.errors import ReconstructionError
from stages.base.stage import Report
from stages.base.text import counted
from stages.cameras.camera_file import FilePoints
from stages.cameras.colmap import NO_OBSERVATIONS, Observations
from stages.scene import Camera

_VISIBLE_SHARE = 0.1  # of a file's points must be in the pictures of two cameras at least


def find_points(
    from_file: FilePoints | None, triangulated: Path, cameras: Sequence[Camera], report: Report
) -> tuple[FilePoints, Observations]:
    """The points to start from, and which views observe them.

    Args:
        from_file: the points of the camera file; used if its cameras look at them.
        triangulated: points.npz of `triangulation`.
        cameras: of the training views.
        report: receives the metric "points_source" and warnings.

    Raises SplatError "cameras-no-points".
    """
    cloud = _visible_file_points(from_file, cameras, report)
    if cloud is not None:
        report.metric("points_source", "camera file")
        return cloud, NO_OBSERVATIONS
    cloud, observations = _triangulated(triangulated)
    if not len(cloud.points):
        raise ReconstructionError(
            "cameras-no-points",
            given="Matches give no point, and the camera file none that can be used.",
            wanted="Points to start from.",
            hint="Export the cameras together with their sparse points.",
        )
    report.metric("points_source", "triangulation")
    return cloud, observations


def _visible_file_points(
    found: FilePoints | None, cameras: Sequence[Camera], report: Report
) -> FilePoints | None:
    if found is None or not len(found.points):
        return None
    views = count_views(cameras, found.points)
    if (views >= 2).mean() < _VISIBLE_SHARE:
        report.warn(
            "cameras-points-elsewhere",
            f"Only {np.mean(views >= 2):.0%} of the file's {counted(len(views), 'point')} are in "
            "the pictures of two of its cameras: they are not used. Check that points and cameras "
            "have the same world and scale.",
        )
        return None
    return replace(found, tracks=np.where(found.tracks > 0, found.tracks, views).astype(np.int32))


def _triangulated(path: Path) -> tuple[FilePoints, Observations]:
    data = np.load(path)
    observed = Observations(data["observed_points"], data["observing_views"], data["observed_px"])
    pairs = np.unique(np.stack([observed.points, observed.views], axis=1), axis=0)
    tracks = np.bincount(pairs[:, 0], minlength=len(data["points"])).astype(np.int32)
    return FilePoints(data["points"], data["colours"], data["errors_px"], tracks), observed


def count_views(cameras: Sequence[Camera], points: NDArray[np.float64]) -> NDArray[np.int32]:
    """[P] number of cameras that have each point in their picture."""
    count = np.zeros(len(points), np.int32)
    for camera in cameras:
        pixels, z = camera.project(points)
        count += camera.shows(pixels) & (z > 0)
    return count
