"""Points for known cameras: from their file, triangulated from matches, or drawn at random."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stages.base.stage import Report
from stages.base.text import counted
from stages.cameras.camera_file import FilePoints
from stages.photos.load import load_mask
from stages.scene import TRANSPARENT, Camera, Photo
from stages.structure.common_view import count_views, random_points
from stages.structure.finish import NO_OBSERVATIONS, Observations
from stages.structure.undistorted_images import mask_file

POINTS_PER_VIEW = 20  # with fewer triangulated points, random ones are added
_VISIBLE_SHARE = 0.1  # of a file's points must be in the pictures of two cameras at least


def find_points(
    from_file: FilePoints | None,
    triangulated: Path,
    training: Sequence[int],
    photos: Sequence[Photo],
    cameras: Sequence[Camera],
    folder: Path,
    seed: int,
    report: Report,
) -> tuple[FilePoints, Observations]:
    """The points to start from, and who observes them.

    Args:
        from_file: the points of the camera file; used if its cameras look at them.
        triangulated: points.npz of `known_cameras_worker`.
        training: positions of the photographs that may be used.
        photos, cameras: of all views; cameras undistorted.
        folder: of the reconstruction, for masks.
        seed: of random points.
        report: receives the metric "points_source" and warnings.

    Raises SplatError "cameras-no-common-view".
    """
    chosen = [cameras[i] for i in training]
    cloud = _visible_file_points(from_file, chosen, report)
    if cloud is not None:
        report.metric("points_source", "camera file")
        return cloud, NO_OBSERVATIONS
    cloud, observations = _triangulated(triangulated, training)
    source = "triangulation"
    if len(cloud.points) < POINTS_PER_VIEW * len(training):
        outside = [_empty_space(folder, photos[i], cameras[i]) for i in training]
        cloud, source = _with_random(cloud, chosen, outside, seed, report), "random"
    report.metric("points_source", source)
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


def _triangulated(path: Path, training: Sequence[int]) -> tuple[FilePoints, Observations]:
    data = np.load(path)
    views = np.array(training, np.int32)[data["observing_views"]]
    observed = Observations(data["observed_points"], views, data["observed_px"])
    pairs = np.unique(np.stack([observed.points, observed.views], axis=1), axis=0)
    tracks = np.bincount(pairs[:, 0], minlength=len(data["points"])).astype(np.int32)
    return FilePoints(data["points"], data["colours"], data["errors_px"], tracks), observed


def _empty_space(folder: Path, photo: Photo, camera: Camera) -> NDArray[np.bool_] | None:
    """[H, W] where a photograph with a transparent background shows nothing; None for others."""
    if photo.outside != TRANSPARENT:
        return None
    mask = load_mask(folder / mask_file(photo), camera.width, camera.height, photo.outside)
    return np.asarray(mask == 0)


def _with_random(
    cloud: FilePoints,
    cameras: Sequence[Camera],
    outside: Sequence[NDArray[np.bool_] | None],
    seed: int,
    report: Report,
) -> FilePoints:
    """The cloud with random points where most cameras look and none shows empty space."""
    points, centre, radius = random_points(cameras, seed, outside)
    at = ", ".join(f"{value:.3g}" for value in centre)
    report.warn(
        "cameras-random-start",
        f"Matches give only {counted(len(cloud.points), 'point')}: training starts from "
        f"{len(points):,} more at random, within {radius:.3g} of ({at}) in the file's units.",
    )
    grey = np.random.default_rng(seed).integers(0, 256, (len(points), 3)).astype(np.uint8)
    return FilePoints(
        np.concatenate([cloud.points, points]),
        np.concatenate([cloud.colours, grey]),
        np.concatenate([cloud.errors_px, np.zeros(len(points))]),
        np.concatenate([cloud.tracks, count_views(cameras, points)]),
    )
