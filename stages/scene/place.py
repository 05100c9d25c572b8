"""Where a scene is on the earth, in one shape for the manifest and for all files.

The local frame points east, north and up and is in metres. Around a place in `GEOGRAPHIC` it is the
plane that touches the ellipsoid there; in a projected system it is the grid itself.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

GEOGRAPHIC = "EPSG:4979"  # WGS 84: latitude and longitude in degrees, height in metres
CRS = re.compile(r"EPSG:[0-9]{4,6}")
# axes of a world that is turned to the local frame: x east, y down, z north
EAST_DOWN_NORTH = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
_HALF_AXIS, _ECCENTRICITY2 = 6_378_137.0, 6.69437999014e-3  # of WGS 84, metres
_ITERATIONS = 6  # of the latitude: each makes its error about 150 times smaller
_LARGEST = 1e9  # of a coordinate, metres


@dataclass(frozen=True)
class EarthPlace:
    """The place of a world.

    Args:
        crs: its coordinate reference system: `GEOGRAPHIC`, or a projected one ("EPSG:25832").
        offset: [3] coordinates of the world's zero point: latitude, longitude, height; or easting,
            northing, height.
        axes: [3, 3] takes a position of the world to metres east, north and up of `offset`.
    """

    crs: str
    offset: NDArray[np.float64]
    axes: NDArray[np.float64]

    def moved(self, old_from_new: NDArray[np.float64]) -> EarthPlace:
        """The place of another world. old_from_new: [4, 4] takes its positions to this one's."""
        shift = self.axes @ old_from_new[:3, 3]
        axes = self.axes @ old_from_new[:3, :3]
        if self.crs != GEOGRAPHIC:
            return replace(self, offset=self.offset + shift, axes=axes)
        if not shift.any():
            return replace(self, axes=axes)
        here = east_north_up(self.offset)
        offset = geodetic(geocentric(self.offset) + shift @ here)
        return replace(self, offset=offset, axes=east_north_up(offset) @ here.T @ axes)

    def beside(self, origin: NDArray[np.float64]) -> EarthPlace:
        """The place of positions to which `origin` [3] is added first."""
        old_from_new = np.eye(4)
        old_from_new[:3, 3] = origin
        return self.moved(old_from_new)

    def to_json(self) -> dict[str, Any]:
        """Plain data: crs, offset and axes."""
        rounded = self.axes.round(12) + 0.0  # no 1e-17 where a zero is meant, no -0
        return {
            "crs": self.crs,
            "offset": [float(value) for value in self.offset],
            "axes": rounded.tolist(),
        }

    @classmethod
    def from_json(cls, data: Any) -> EarthPlace:
        """The place that `to_json` wrote. Raises ValueError for anything else."""
        if not isinstance(data, Mapping) or not CRS.fullmatch(str(data.get("crs"))):
            raise ValueError("its place names no coordinate reference system")
        try:
            offset = np.array(data.get("offset"), np.float64)
            axes = np.array(data.get("axes"), np.float64)
        except TypeError as error:
            raise ValueError("its place holds something that is not a number") from error
        if offset.shape != (3,) or axes.shape != (3, 3):
            raise ValueError("its place is not three coordinates and three axes")
        usable = np.abs(offset).max() < _LARGEST and np.abs(axes).max() < _LARGEST  # False for NaN
        if not usable or not np.linalg.det(axes) > 0:
            raise ValueError("its place is not one on the earth")
        return cls(str(data["crs"]), offset, axes)


def geocentric(places: NDArray[np.float64]) -> NDArray[np.float64]:
    """[..., 3] geocentric metres of latitude, longitude (degrees) and height [..., 3] on WGS 84."""
    latitude, longitude = np.radians(places[..., 0]), np.radians(places[..., 1])
    height = places[..., 2]
    normal = _HALF_AXIS / np.sqrt(1.0 - _ECCENTRICITY2 * np.sin(latitude) ** 2)
    across = (normal + height) * np.cos(latitude)
    return np.stack(
        [
            across * np.cos(longitude),
            across * np.sin(longitude),
            (normal * (1.0 - _ECCENTRICITY2) + height) * np.sin(latitude),
        ],
        axis=-1,
    )


def geodetic(positions: NDArray[np.float64]) -> NDArray[np.float64]:
    """[..., 3] the inverse of `geocentric`, within 100 km of the ellipsoid."""
    x, y, z = np.moveaxis(positions, -1, 0)
    across = np.hypot(x, y)
    latitude = np.arctan2(z, across * (1.0 - _ECCENTRICITY2))
    for _ in range(_ITERATIONS):
        normal = _HALF_AXIS / np.sqrt(1.0 - _ECCENTRICITY2 * np.sin(latitude) ** 2)
        latitude = np.arctan2(z + _ECCENTRICITY2 * normal * np.sin(latitude), across)
    normal = _HALF_AXIS / np.sqrt(1.0 - _ECCENTRICITY2 * np.sin(latitude) ** 2)
    # along the normal of the ellipsoid, which is defined at the poles as well
    outside = across * np.cos(latitude) + z * np.sin(latitude) - _HALF_AXIS**2 / normal
    return np.stack([np.degrees(latitude), np.degrees(np.arctan2(y, x)), outside], axis=-1)


def east_north_up(place: NDArray[np.float64]) -> NDArray[np.float64]:
    """[3, 3] rows: geocentric directions east, north and up at latitude and longitude (degrees)."""
    (sp, sl), (cp, cl) = np.sin(np.radians(place[:2])), np.cos(np.radians(place[:2]))
    return np.array([[-sl, cl, 0.0], [-sp * cl, -sp * sl, cp], [cp * cl, cp * sl, sp]])


def local_positions(
    places: NDArray[np.float64], around: NDArray[np.float64]
) -> NDArray[np.float64]:
    """[N, 3] metres east, north and up of `around` [3]; both latitude, longitude and height."""
    away = geocentric(places) - geocentric(around)
    return np.asarray(away @ east_north_up(around).T)
