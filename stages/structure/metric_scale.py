"""Metric scale and north of a reconstruction, from a known length or from GPS."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stages.base.errors import Family, SplatError
from stages.base.stage import Report
from stages.scene import Camera, Photo
from stages.structure.markers import marker_sides

_FEWEST_GPS = 5
_AGREEING_SHARE = 0.6  # of the photographs with GPS
_WORST_RESIDUAL = 0.15  # of the spread of the cameras; beyond, GPS is too inaccurate
_GPS_ERROR_M = 10.0  # of a phone's receiver; positions that spread less say nothing of the scale
_WORST_SPREAD = 0.05  # median relative deviation of the sides of markers, all of one size
_HYPOTHESES = 2000  # of the robust fit, at most
# WGS 84: half axis in metres, eccentricity squared
_AXIS, _ECCENTRICITY2 = 6_378_137.0, 6.69437999014e-3


@dataclass(frozen=True)
class KnownScale:
    """What is known of the scale.

    Args:
        distance: names of two photographs and the distance of their cameras in metres; or ().
        marker: side of the printed markers in metres; 0 for none.
        metres_per_unit: of known cameras; 0 if unknown.
        source: what states metres_per_unit.
    """

    distance: Sequence[str] = ()
    marker: float = 0.0
    metres_per_unit: float = 0.0
    source: str = ""


UNKNOWN_SCALE = KnownScale()


@dataclass(frozen=True)
class MetricScale:
    """metres: per unit of the world. heading: rotation about the vertical in radians after which +Z
    is north and +X east; 0 if unknown. source: a description for the manifest."""

    metres: float
    heading: float
    source: str

    @property
    def turn(self) -> NDArray[np.float64]:
        """[3, 3] rotation from the old to the new world, about y, which points down."""
        c, s = math.cos(self.heading), math.sin(self.heading)
        return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])

    def poses(self, world_to_camera: NDArray[np.float64]) -> NDArray[np.float64]:
        """[V, 4, 4] the poses in the new world."""
        moved = np.array(world_to_camera)
        moved[:, :3, :3] = moved[:, :3, :3] @ self.turn.T
        moved[:, :3, 3] *= self.metres
        return moved

    def cameras(self, cameras: Sequence[Camera]) -> list[Camera]:
        """The cameras in the new world."""
        poses = self.poses(np.array([camera.world_to_camera for camera in cameras]))
        return [replace(c, world_to_camera=pose) for c, pose in zip(cameras, poses, strict=True)]

    def points(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """[P, 3] the points in the new world."""
        return np.asarray(self.metres * points @ self.turn.T)


def find_metric_scale(
    known: KnownScale,
    photos: Sequence[Photo],
    cameras: Sequence[Camera],
    pictures: Sequence[Path],
    levelled: bool,
    report: Report,
) -> MetricScale | None:
    """The metric scale: by a distance or marker of the user, else by the camera file, else by GPS.
    None if none of these is known.

    Args:
        known: what the user or the camera file states.
        photos, cameras, pictures: [V] the registered photographs, their pinhole cameras, and the
            files of their undistorted pictures.
        levelled: whether up is -Y.
        report: receives metrics.

    Raises SplatError for a distance or a marker that cannot be used.
    """
    centres = np.array([camera.centre for camera in cameras])
    if known.distance:
        metric: MetricScale | None = _from_distance(known.distance, photos, centres)
    elif known.marker:
        metric = _from_markers(known.marker, marker_sides(pictures, cameras), report)
    elif known.metres_per_unit:
        metric = MetricScale(known.metres_per_unit, 0.0, known.source)
    else:
        metric = _from_gps(photos, centres, levelled, report)
    report.metric("scale_source", metric.source if metric else "nothing")
    report.metric("metres_per_unit", metric.metres if metric else None)
    return metric


def check_distance(distance: Sequence[str], photos: Sequence[Photo]) -> float:
    """The metres of a `KnownScale.distance`. Raises SplatError if it cannot be of these photos."""
    *ends, text = distance
    try:
        metres = float(text)
    except ValueError:
        metres = math.nan
    if not (math.isfinite(metres) and metres > 0):
        raise _unusable(f"{text} is not a distance in metres")
    for name in ends:
        if name not in {photo.name for photo in photos}:
            raise _unusable(f"{name} is not a photograph of the capture or was not registered")
    return metres


def _from_distance(
    distance: Sequence[str], photos: Sequence[Photo], centres: NDArray[np.float64]
) -> MetricScale:
    metres = check_distance(distance, photos)
    first, second, _ = distance
    names = [photo.name for photo in photos]
    a, b = (centres[names.index(name)] for name in (first, second))
    units = float(np.linalg.norm(a - b))
    spread = float(np.linalg.norm(centres - np.median(centres, axis=0), axis=1).max())
    if units < 1e-3 * spread:
        raise _unusable(f"{first} and {second} were taken from the same place")
    return MetricScale(metres / units, 0.0, f"{first} and {second} are {metres:g} m apart")


def _from_markers(metres: float, sides: NDArray[np.float64], report: Report) -> MetricScale:
    report.metric("markers", len(sides) // 4)
    if not len(sides):
        raise _no_marker("no ArUco marker was found in two photographs from different directions")
    side = float(np.median(sides))
    spread = float(np.median(np.abs(sides / side - 1.0)))
    report.metric("marker_sides_spread", round(spread, 5))
    if spread > _WORST_SPREAD:
        raise _no_marker(f"the sides of {len(sides) // 4} markers differ by {spread:.0%}")
    return MetricScale(metres / side, 0.0, f"{len(sides) // 4} markers of {metres:g} m")


def _from_gps(
    photos: Sequence[Photo], centres: NDArray[np.float64], levelled: bool, report: Report
) -> MetricScale | None:
    """By horizontal positions alone: GPS heights are less accurate than levelling by cameras."""
    rows = [i for i, photo in enumerate(photos) if photo.gps is not None]
    report.metric("with_gps", len(rows))
    if not rows:
        return None
    earth = east_north([photos[i].gps or (0.0, 0.0) for i in rows])
    here = centres[rows, 0] + 1j * centres[rows, 2]  # x and z become east and north
    there = earth[:, 0] + 1j * earth[:, 1]
    spread = float(np.sqrt(np.mean(np.abs(there - there.mean()) ** 2)))
    report.metric("gps_spread_m", round(spread, 3))
    factor, inliers, residual = 0j, np.zeros(len(rows), np.bool_), math.inf
    if levelled and len(rows) >= _FEWEST_GPS:
        factor, inliers, residual = fit_similarity_2d(here, there)
    agreeing = int(inliers.sum())
    if abs(factor):
        report.metric("gps_residual_m", round(residual, 3))
        report.metric("gps_agreeing", agreeing)
    unused = ""
    if len(rows) < _FEWEST_GPS:
        unused = f"{_FEWEST_GPS} photographs are needed"
    elif not levelled:
        unused = "the up direction was not found"
    elif abs(factor) == 0:
        unused = "most cameras or positions are at one place"
    elif agreeing < max(_FEWEST_GPS, _AGREEING_SHARE * len(rows)):
        unused = f"only {agreeing} of them agree with the cameras"
    elif residual > _WORST_RESIDUAL * spread:
        unused = f"they differ from the cameras by {residual:.1f} m (RMS)"
    if unused:
        _report_unused(unused, len(rows), len(photos), spread, report)
        return None
    # (x + iz) e^(i angle) rotates x towards z; `turn` rotates the other way.
    return MetricScale(
        float(abs(factor)),
        -float(np.angle(factor)),
        f"GPS of {int(inliers.sum())} photographs, {residual:.2g} m off",
    )


def _report_unused(why: str, count: int, total: int, spread: float, report: Report) -> None:
    """Report why GPS is not used; as a warning if the scale could have come from it.

    Args:
        why: the reason.
        count, total: photographs with GPS, and all photographs.
        spread: of the GPS positions, metres.
        report: receives a metric and the warning.
    """
    report.metric("gps_unused", why)
    if spread >= _GPS_ERROR_M:
        report.warn(
            "sfm-gps-unused",
            f"{count} of {total} photographs have GPS, spread over {spread:.0f} m (RMS). It is not "
            f"used for scale and north: {why}. Give a known distance with --scale if the scene "
            "must be in metres.",
        )


def fit_similarity_2d(
    here: NDArray[np.complex128], there: NDArray[np.complex128]
) -> tuple[complex, NDArray[np.bool_], float]:
    """Robust fit of a similarity of the plane that maps `here` [N] to `there` [N].

    Least median of squares over hypotheses from two points each (Rousseeuw 1984), then least
    squares over inliers. Returns (complex factor, inliers [N], RMS residual of the inliers).
    """
    first, second = np.triu_indices(len(here), 1)
    chosen = np.linspace(0, len(first) - 1, min(len(first), _HYPOTHESES)).astype(int)
    best, least = 0j, math.inf
    for i, j in zip(first[chosen], second[chosen], strict=True):
        if abs(here[j] - here[i]) == 0:
            continue
        factor = (there[j] - there[i]) / (here[j] - here[i])
        off = float(np.median(np.abs(there - there[i] - factor * (here - here[i]))))
        if off < least:
            best, least, anchor = factor, off, i
    if not math.isfinite(least):
        return 0j, np.zeros(len(here), np.bool_), math.inf
    inliers = np.abs(there - there[anchor] - best * (here - here[anchor])) <= 3.0 * least + 1e-9
    a, b = here[inliers] - here[inliers].mean(), there[inliers] - there[inliers].mean()
    factor = complex((a.conj() @ b) / max(float((a.conj() @ a).real), 1e-300))
    return factor, inliers, float(np.sqrt(np.mean(np.abs(b - factor * a) ** 2)))


def east_north(places: Sequence[tuple[float, float]]) -> NDArray[np.float64]:
    """[N, 2] metres east and north of the median of `places` (latitude, longitude in degrees)."""
    degrees = np.array(places, np.float64)
    longitude = np.unwrap(degrees[:, 1], period=360.0)  # across the 180th meridian
    latitude = np.radians(degrees[:, 0])
    middle = float(np.median(latitude))
    curvature = 1.0 - _ECCENTRICITY2 * math.sin(middle) ** 2
    north = _AXIS * (1.0 - _ECCENTRICITY2) / curvature**1.5 * (latitude - middle)
    east = (
        _AXIS / math.sqrt(curvature) * np.cos(middle) * np.radians(longitude - np.median(longitude))
    )
    return np.stack([east, north], axis=1)


def _no_marker(why: str) -> SplatError:
    return SplatError(
        "sfm-marker",
        given=f"--marker cannot be used: {why}.",
        wanted="Printed ArUco markers of one size, flat, sharp, with their white margin; alone or "
        "on a ChArUco board.",
        hint="Leave --marker away, or give a distance with --scale instead.",
        family=Family.RECONSTRUCTION,
    )


def _unusable(why: str) -> SplatError:
    return SplatError(
        "sfm-scale",
        given=f"--scale cannot be used: {why}.",
        wanted="Two photographs, as the capture names them, that were taken at different places, "
        "and the distance between their cameras in metres: --scale A.jpg B.jpg 0.85",
        hint="Choose two that are far apart: then an error of a centimetre matters little.",
        family=Family.USAGE,
    )
