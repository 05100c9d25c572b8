"""Points for known cameras: from their file, triangulated from matches, or drawn at random in the
space that many cameras see."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stages.base.errors import SplatError
from stages.base.stage import Report
from stages.base.text import counted, listed
from stages.cameras.camera_file import FilePoints
from stages.cameras.colmap import NO_OBSERVATIONS, Observations
from stages.scene import Camera
from stages.sfm.known.pinhole_views import PinholeView

POINTS_PER_PHOTOGRAPH = 20  # with fewer triangulated points, random ones are added
_VISIBLE_SHARE = 0.1  # of a file's points must be in the pictures of two cameras at least


def find_points(
    from_file: FilePoints | None,
    triangulated: Path,
    views: Sequence[PinholeView],
    whole: Sequence[Camera],
    seed: int,
    report: Report,
) -> tuple[FilePoints, Observations]:
    """The points to start from, and which views observe them.

    Args:
        from_file: the points of the camera file; used if its cameras look at them.
        triangulated: points.npz of `triangulation`.
        views: V training views.
        whole: [V] a pinhole camera for the photograph of each view.
        seed: of random points.
        report: receives the metric "points_source" and warnings.

    Raises SplatError "cameras-no-common-view".
    """
    cloud = _visible_file_points(from_file, [view.camera for view in views], report)
    if cloud is not None:
        report.metric("points_source", "camera file")
        return cloud, NO_OBSERVATIONS
    cloud, observations = _triangulated(triangulated)
    source = "triangulation"
    photographs = {v.number: (camera, v) for v, camera in zip(views, whole, strict=True)}
    if len(cloud.points) < POINTS_PER_PHOTOGRAPH * len(photographs):
        cameras = [camera for camera, _ in photographs.values()]
        names = [view.photo.source for _, view in photographs.values()]
        cloud = _with_random(cloud, cameras, names, seed, report)
        source = "random"
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


def _triangulated(path: Path) -> tuple[FilePoints, Observations]:
    data = np.load(path)
    observed = Observations(data["observed_points"], data["observing_views"], data["observed_px"])
    pairs = np.unique(np.stack([observed.points, observed.views], axis=1), axis=0)
    tracks = np.bincount(pairs[:, 0], minlength=len(data["points"])).astype(np.int32)
    return FilePoints(data["points"], data["colours"], data["errors_px"], tracks), observed


def _with_random(
    cloud: FilePoints,
    cameras: Sequence[Camera],
    names: Sequence[str],
    seed: int,
    report: Report,
) -> FilePoints:
    """The cloud with random points where most cameras look."""
    points, centre, radius = random_points(cameras, seed, names)
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


RANDOM_POINTS = 20_000
_PARALLEL = 0.02  # smallest eigenvalue per camera; below, the optical axes are nearly parallel
_SHARE = 0.5  # of the cameras must see a point
_NAMED = 3  # photographs, as examples


def count_views(cameras: Sequence[Camera], points: NDArray[np.float64]) -> NDArray[np.int32]:
    """[P] number of cameras that have each point in their picture."""
    count = np.zeros(len(points), np.int32)
    for camera in cameras:
        pixels, z = camera.project(points)
        count += camera.shows(pixels) & (z > 0)
    return count


def random_points(
    cameras: Sequence[Camera],
    seed: int,
    names: Sequence[str] = (),
) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """(points [P, 3] in a ball that most cameras see, its centre [3], its radius).

    The centre is the point nearest to all optical axes (least squares); the radius is the median of
    what a camera sees around it.

    Args:
        cameras: pinholes.
        seed: of the random points.
        names: for each camera, its photograph's, for the error.

    Raises SplatError "cameras-no-common-view".
    """
    centres = np.array([camera.centre for camera in cameras])
    forward = np.array([camera.forward for camera in cameras])
    perpendicular = np.eye(3) - np.einsum("vi,vj->vij", forward, forward)
    scatter = perpendicular.mean(axis=0)
    if np.linalg.eigvalsh(scatter)[0] < _PARALLEL:
        axes = f"The optical axes of {_some(names, np.ones(len(cameras), np.bool_))}"
        raise _no_common_view(f"{axes} are nearly parallel")
    middle = np.linalg.solve(scatter, np.einsum("vij,vj->i", perpendicular, centres) / len(cameras))
    depth = np.einsum("vi,vi->v", middle - centres, forward)
    half = [min(c.width / c.fx, c.height / c.fy) / 2 for c in cameras]
    ahead = depth > 0
    if ahead.mean() < _SHARE:
        sides = f"{_some(names, ~ahead)} look away from where the optical axes meet"
        raise _no_common_view(f"{sides}, and {_some(names, ahead)} look towards it")
    radius = float(np.median(depth[ahead] * np.sin(np.arctan(half))[ahead]))
    random = np.random.default_rng(seed)
    directions = random.normal(size=(4 * RANDOM_POINTS, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    lengths = radius * np.cbrt(random.uniform(size=(len(directions), 1)))
    points = middle + lengths * directions
    points = points[count_views(cameras, points) >= _SHARE * len(cameras)]
    points = points[:RANDOM_POINTS]
    if len(points) < RANDOM_POINTS // 20:
        sees = np.array([count_views([camera], middle[None])[0] > 0 for camera in cameras])
        sides = f"{_some(names, sees)} have the place where the optical axes meet in their pictures"
        sides = f"{sides}, and {_some(names, ~sees)} do not"
        raise _no_common_view(f"Few of them see the same part of space: {sides}")
    return points, middle, radius


def _some(names: Sequence[str], chosen: NDArray[np.bool_]) -> str:
    """ "5 of 12 photographs (a.jpg, b.jpg, c.jpg and 2 more)": those `chosen` [V] of all, with some
    of their names, if they have names."""
    called = listed([name for name, one in zip(names, chosen, strict=False) if one], _NAMED)
    count = f"{chosen.sum()} of {counted(len(chosen), 'photograph')}"
    return f"{count} ({called})" if called else count


def _no_common_view(why: str) -> SplatError:
    return SplatError(
        "cameras-no-common-view",
        given=f"Matches give too few points, and random points need a common view. {why}.",
        wanted="Cameras around a subject, photographs with texture, or points in the file.",
        hint="Export the cameras together with their sparse points.",
    )
