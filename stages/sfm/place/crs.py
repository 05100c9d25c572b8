"""Projected coordinate reference systems, by PROJ; the extra `geo`."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.base.distribution import install_command
from stages.base.errors import UsageError
from stages.base.stage import Report
from stages.scene.place import (
    GEOGRAPHIC,
    EarthPlace,
    east_north_up,
    geocentric,
    geodetic,
)
from stages.sfm.place.gps import MetricScale, about_vertical

# Of the differences that give the axes of the grid. Short: a grid is cut at the 180th meridian.
_STEP_M = 1.0
# Of lengths in the grid, relative. Zones of UTM and of most countries stretch less than 0.3 %.
_LARGEST_STRETCH = 0.005
_UTM_LATITUDES = (-80.0, 84.0)


def turned_to_grid(scale: MetricScale, crs: str, report: Report) -> MetricScale:
    """The scale after which +X and +Z follow the east and north of the grid `crs`, in its metres.

    Coordinates are then those of the world plus one offset; heights stay as they are, so that one
    metre up is not quite one unit (the third axis of the place says how much).

    Args:
        scale: with a place.
        crs: checked by `projected_system`.
        report: receives a warning for a place outside the area that the system is made for, and
            for one where the grid's metres are not those of the ground.

    Raises SplatError "crs-elsewhere".
    """
    assert scale.place is not None
    place = in_crs(scale.place, crs, report)
    _warn_stretched(scale.place, crs, report)
    (ax, az), (bx, bz) = place.axes[:2, [0, 2]]
    factor = (ax + bz) / 2 + 1j * (bx - az) / 2
    return MetricScale(scale.metres, scale.source, scale.turn, place).followed_by(
        float(abs(factor)), about_vertical(-float(np.angle(factor)))
    )


def in_crs(place: EarthPlace, crs: str, report: Report) -> EarthPlace:
    """The same place in the projected system `crs`, as far as a plane can follow it. Raises
    SplatError "crs-elsewhere", and "crs-not-projected" for a system that is a mirror image."""
    import pyproj

    target = projected_system(crs)
    transform = pyproj.Transformer.from_crs(place.crs, target, always_xy=True).transform

    def coordinates(local: NDArray[np.float64]) -> NDArray[np.float64]:
        """[N, 3] easting, northing, height of metres east, north and up of the place [N, 3]."""
        if place.crs == GEOGRAPHIC:
            at = geodetic(geocentric(place.offset) + local @ east_north_up(place.offset))
            x, y, z = transform(at[:, 1], at[:, 0], at[:, 2])
        else:
            at = place.offset + local
            x, y, z = transform(at[:, 0], at[:, 1], at[:, 2])
        return np.stack([x, y, z], axis=1)

    steps = _STEP_M * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
    found = coordinates(steps)
    if not np.isfinite(found).all():
        raise UsageError(
            "crs-elsewhere",
            given=f"The scene lies at {_written(place)}, which {crs} does not cover.",
            wanted="The system of the region where the photographs were taken.",
            hint="Choose another --crs, or leave it away.",
        )
    grid = (found[1:4] - found[4:]).T / (2 * _STEP_M)
    if np.linalg.det(grid) <= 0:
        raise UsageError(
            "crs-not-projected",
            given=f"--crs {crs} ({target.name}) counts to the south and west, as a mirror image.",
            wanted="A system that counts to the east and north.",
            hint="Choose another of the region: for EPSG:5513, EPSG:5514.",
        )
    _warn_outside(place, target, crs, report)
    return EarthPlace(crs, found[0], grid @ place.axes)


def _warn_stretched(place: EarthPlace, crs: str, report: Report) -> None:
    import pyproj

    latitude, longitude = _geographic(place)
    factors = pyproj.Proj(projected_system(crs)).get_factors(longitude, latitude)
    stretch = float(np.sqrt(factors.areal_scale))
    if abs(stretch - 1) <= _LARGEST_STRETCH or not np.isfinite(stretch):
        return
    advice = "Choose a system with a smaller region."
    if _UTM_LATITUDES[0] <= latitude < _UTM_LATITUDES[1]:
        zone = int((longitude + 180) // 6) % 60 + 1
        advice = f"Choose the UTM zone: EPSG:{(32600 if latitude >= 0 else 32700) + zone}."
    report.warn(
        "sfm-crs-stretched",
        f"{crs} stretches lengths by {stretch:.4g} here: a metre of the files is "
        f"{1 / stretch:.4g} m on the ground. {advice}",
    )


def _geographic(place: EarthPlace) -> tuple[float, float]:
    """Latitude and longitude in degrees."""
    import pyproj

    if place.crs == GEOGRAPHIC:
        return float(place.offset[0]), float(place.offset[1])
    back = pyproj.Transformer.from_crs(place.crs, GEOGRAPHIC, always_xy=True)
    x, y, z = place.offset
    longitude, latitude, _ = back.transform(x, y, z)
    return latitude, longitude


def _warn_outside(place: EarthPlace, target: Any, crs: str, report: Report) -> None:
    latitude, longitude = _geographic(place)
    area = target.area_of_use
    if area is None or (
        area.south <= latitude <= area.north
        and (longitude - area.west) % 360 <= ((area.east - area.west) % 360 or 360)
    ):
        return
    report.warn(
        "sfm-crs-outside",
        f"{crs} ({target.name}) is made for {area.name}. The scene lies outside, at "
        f"{latitude:.4f}, {longitude:.4f}; distances in the grid may be distorted.",
    )


def _written(place: EarthPlace) -> str:
    return f"{place.crs} " + ", ".join(f"{value:.6g}" for value in place.offset)


def projected_system(crs: str) -> Any:
    """The `pyproj.CRS` of `crs` ("EPSG:25832"). Raises SplatError if that is not a projected system
    in metres that is known here."""
    try:
        import pyproj
    except ImportError as error:
        raise UsageError(
            "crs-needs-pyproj",
            given=f"--crs {crs} needs pyproj, which is not installed.",
            wanted="The extra `geo`.",
            hint=f"{install_command('geo')}; or leave --crs away.",
        ) from error
    try:
        system = pyproj.CRS.from_user_input(crs)
    except pyproj.exceptions.CRSError as error:
        raise UsageError(
            "crs-unknown",
            given=f"--crs {crs} is not in the EPSG registry of PROJ {pyproj.proj_version_str}.",
            wanted="The code of a projected system, such as EPSG:25832 for UTM zone 32.",
            hint="Check the code.",
        ) from error
    units = {axis.unit_name for axis in system.axis_info}
    if not system.is_projected or len(system.axis_info) != 2 or units != {"metre"}:
        raise UsageError(
            "crs-not-projected",
            given=f"--crs {crs} ({system.name}) is not a horizontal grid in metres.",
            wanted="A projected system with two axes in metres, such as EPSG:25832.",
            hint="Latitude and longitude are written without --crs, as EPSG:4979.",
        )
    return system
