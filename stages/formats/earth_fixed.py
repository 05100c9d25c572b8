"""From a place on the earth to the earth-centred, earth-fixed frame of globes (EPSG:4978)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stages.base.distribution import install_command
from stages.base.errors import UsageError
from stages.scene.place import GEOGRAPHIC, EarthPlace, east_north_up, geocentric

_STEP_M = 10.0  # of the grid, over which its directions are measured


def earth_from_place(place: EarthPlace) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """([3, 3], [3]) that take a position of the world of `place` to geocentric metres. Around a
    place in a projected system they follow its grid as far as a plane can. Raises SplatError
    "tiles-need-pyproj" for such a place where pyproj is missing."""
    if place.crs == GEOGRAPHIC:
        return east_north_up(place.offset).T @ place.axes, geocentric(place.offset)
    try:
        import pyproj
    except ImportError as error:
        raise UsageError(
            "tiles-need-pyproj",
            given=f"The scene lies in {place.crs}, and pyproj is not installed.",
            wanted="The extra `geo`, which turns its coordinates to those of a globe.",
            hint=install_command("geo"),
        ) from error
    transform = pyproj.Transformer.from_crs(place.crs, GEOGRAPHIC, always_xy=True).transform
    steps = _STEP_M * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
    x, y, z = (place.offset + steps).T
    longitude, latitude, height = transform(x, y, z)
    geographic = np.stack([latitude, longitude, height], axis=1)
    if not np.isfinite(geographic).all():
        raise UsageError(
            "tiles-elsewhere",
            given=f"The scene lies where {place.crs} has no coordinates.",
            wanted="A place in the area of its coordinate system.",
            hint="Write another format.",
        )
    found = geocentric(geographic)
    return ((found[1:4] - found[4:]).T / (2 * _STEP_M)) @ place.axes, found[0]
