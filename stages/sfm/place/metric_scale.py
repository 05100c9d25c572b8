"""Metric scale, north and place of a reconstruction: by a known length, the camera file or GPS."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stages.base.errors import Family, ReconstructionError, SplatError, UsageError
from stages.base.stage import Report
from stages.cameras.camera_file import NO_GEOREFERENCE, Georeference
from stages.scene import Camera, Photo
from stages.sfm.place.crs import turned_to_grid
from stages.sfm.place.gps import MetricScale, scale_from_gps
from stages.sfm.place.markers import marker_sides

_WORST_SPREAD = 0.05  # median relative deviation of the sides of markers, all of one size


@dataclass(frozen=True)
class KnownScale:
    """What is known of the scale.

    Args:
        distance: names of two photographs and the distance of their cameras in metres; or ().
        marker: side of the printed markers in metres; 0 for none.
        crs: the projected coordinate reference system to turn the world to; "" for none.
        metres: whether the user says that known cameras are in metres.
        georeference: what the file of known cameras says.
    """

    distance: Sequence[str] = ()
    marker: float = 0.0
    crs: str = ""
    metres: bool = False
    georeference: Georeference = NO_GEOREFERENCE

    def given_by(self) -> str:
        """The option by which the user gives the scale; "" if none does."""
        options = {"--scale": self.distance, "--marker": self.marker, "--metres": self.metres}
        return next((name for name, given in options.items() if given), "")


UNKNOWN_SCALE = KnownScale()


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
        if known.marker:
            report.warn(
                "sfm-marker-unused",
                f"--marker {known.marker:g} is not used: the distance of --scale says how large "
                "the scene is. Give only one of them: --marker 0 takes it back.",
            )
    elif known.marker:
        metric = _from_markers(known.marker, marker_sides(pictures, cameras), report)
    elif known.metres:
        metric = MetricScale(1.0, "--metres")
    elif known.georeference.metres_per_unit:
        metric = MetricScale(known.georeference.metres_per_unit, known.georeference.source)
    else:
        metric = scale_from_gps(photos, centres, levelled, report)
    metric = _placed(metric, known, report)
    report.metric("scale_source", metric.source if metric else "nothing")
    report.metric("metres_per_unit", metric.metres if metric else None)
    if metric is not None and metric.place is not None:
        report.metric("place", metric.place.to_json())
    return metric


def _placed(metric: MetricScale | None, known: KnownScale, report: Report) -> MetricScale | None:
    """With the place of known cameras, and turned to the grid that is requested."""
    place = known.georeference.place
    if metric is not None and place is not None:
        old = MetricScale(1.0, metric.source, place=place)
        metric = old.followed_by(metric.metres, metric.turn)
    if not known.crs:
        return metric
    if metric is None or metric.place is None:
        option = known.given_by()
        why = (
            f". {option} gives the size of the scene, and GPS is not used beside it"
            if option
            else ", neither from GPS nor from the file of --cameras"
        )
        report.warn(
            "sfm-crs-unused",
            f"--crs {known.crs} is not used: where the scene lies is not known{why}.",
        )
        return metric
    return turned_to_grid(metric, known.crs, report)


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
        if name not in {photo.source for photo in photos}:
            raise _unusable(f"{name} is not a photograph of the capture or was not registered")
    return metres


def _from_distance(
    distance: Sequence[str], photos: Sequence[Photo], centres: NDArray[np.float64]
) -> MetricScale:
    metres = check_distance(distance, photos)
    first, second, _ = distance
    names = [photo.source for photo in photos]
    a, b = (centres[names.index(name)] for name in (first, second))
    units = float(np.linalg.norm(a - b))
    spread = float(np.linalg.norm(centres - np.median(centres, axis=0), axis=1).max())
    if units < 1e-3 * spread:
        raise _unusable(f"{first} and {second} were taken from the same place")
    return MetricScale(metres / units, f"{first} and {second} are {metres:g} m apart")


def _from_markers(metres: float, sides: NDArray[np.float64], report: Report) -> MetricScale:
    report.metric("markers", len(sides) // 4)
    if not len(sides):
        raise _no_marker("no ArUco marker was found in two photographs from different directions")
    side = float(np.median(sides))
    spread = float(np.median(np.abs(sides / side - 1.0)))
    report.metric("marker_sides_spread", round(spread, 5))
    if spread > _WORST_SPREAD:
        raise _no_marker(f"the sides of {len(sides) // 4} markers differ by {spread:.0%}")
    return MetricScale(metres / side, f"{len(sides) // 4} markers of {metres:g} m")


def _no_marker(why: str) -> SplatError:
    return ReconstructionError(
        "sfm-marker",
        given=f"--marker cannot be used: {why}.",
        wanted="Printed ArUco markers of one size, flat, sharp, with their white margin; alone or "
        "on a ChArUco board.",
        hint="Leave --marker away (--marker 0 takes it back), or give a distance with --scale.",
        family=Family.INPUT,
    )


def _unusable(why: str) -> SplatError:
    return UsageError(
        "sfm-scale",
        given=f"--scale cannot be used: {why}.",
        wanted="Two photographs, as the capture names them, that were taken at different places, "
        "and the distance between their cameras in metres: --scale A.jpg B.jpg 0.85",
        hint="Choose two that are far apart: then an error of a centimetre matters little.",
    )
