"""ODM's odm_report/shots.geojson, with the lenses of the project's cameras.json.

`translation` is the centre of the camera in the projection of the project: metres east, north and
up; reading subtracts a whole number. `rotation` is an axis-angle vector of the same world, world to
camera with our axes. The coordinates of the point are longitude, latitude and height. The file does
not name its projection: it is the zone of UTM in which coordinates and translations agree. Focal
lengths are in units of the longer side. Without cameras.json the lens is a pinhole of that focal
length.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.base.bad_files import CAMERAS, BadFileError, reading
from stages.cameras.camera_file import CameraFile, Georeference, camera_file, json_of, poses_of
from stages.cameras.lens import PINHOLE, Lens
from stages.cameras.opensfm import optics_of, rotations_of
from stages.scene.place import EarthPlace

_NAME = "shots.geojson"
_SOURCE = "the projection of shots.geojson"
_AGREEING_M = 5.0
_HALF_AXIS, _FLATTENING, _UTM_SCALE = 6_378_137.0, 1 / 298.257223563, 0.9996


def locate(path: Path) -> Path | None:
    """A .geojson, itself or in the folder `path` or ODM's project `path`."""
    if path.is_dir():
        near = (path / _NAME, path / "odm_report" / _NAME)
        return next((file for file in near if file.is_file()), None)
    return path if path.suffix.lower() == ".geojson" and path.is_file() else None


def read(path: Path) -> CameraFile:
    """The cameras of all shots; pictures are in `images` of the project. Raises SplatError
    "cameras-unreadable"."""
    lenses = _lenses(path)
    with reading(path, CAMERAS):
        shots = json_of(path)["features"]
        if not shots:
            raise BadFileError("it holds no camera")
        about = [shot["properties"] for shot in shots]
        optics = [_optics(shot, lenses) for shot in about]
        names = [str(shot["filename"]) for shot in about]
        turns = np.array([shot["rotation"] for shot in about], np.float64).reshape(-1, 3)
        centres = np.array([shot["translation"] for shot in about], np.float64).reshape(-1, 3)
        where = np.array([shot["geometry"]["coordinates"][:2] for shot in shots], np.float64)
        if not np.isfinite(where).all():
            raise BadFileError("a place is not two numbers")
        with np.errstate(all="ignore"):  # `camera_file` checks the result; no zone fits bad places
            rotations = rotations_of(turns)
            place = _place(where.reshape(-1, 2), centres)
        poses = poses_of(rotations, centres - place.offset if place else centres)
        georeference = Georeference(1.0, np.eye(3), _SOURCE, place)
        root = path.parent.parent if path.parent.name == "odm_report" else path.parent
        return camera_file(root / "images", names, optics, poses, georeference)


def files(path: Path) -> list[Path]:
    """The file, and cameras.json beside it or in the project."""
    near = (folder / "cameras.json" for folder in (path.parent, path.parent.parent))
    return [path, *(file for file in near if file.is_file())][:2]


def _lenses(path: Path) -> dict[str, tuple[list[float], Lens]]:
    """By the name of the camera."""
    file = files(path)[-1]
    if file == path:
        return {}
    with reading(file, CAMERAS):
        cameras = json_of(file)
        # OpenSfM's names begin with a version, which ODM leaves out here
        return {str(name): optics_of(camera) for name, camera in cameras.items()}


def _optics(
    shot: dict[str, Any], lenses: dict[str, tuple[list[float], Lens]]
) -> tuple[list[float], Lens]:
    """(width, height, fx, fy, cx, cy in pixels; the lens) of a shot. Older files do not name the
    camera: then the project's only camera is meant."""
    size = [float(shot["width"]), float(shot["height"])]
    only = next(iter(lenses)) if len(lenses) == 1 else ""
    found = lenses.get(str(shot.get("camera", only)).removeprefix("v2 "))
    if found is not None and found[0][:2] == size:
        return found
    focal = float(shot["focal"]) * max(size)
    return [*size, focal, focal, size[0] / 2, size[1] / 2], PINHOLE


def _place(where: NDArray[np.float64], centres: NDArray[np.float64]) -> EarthPlace | None:
    """The zone of UTM in which longitudes and latitudes [N, 2] have these coordinates [N, 3], and a
    place in their middle."""
    longitude, latitude = np.median(where, axis=0)
    nearest = math.floor((longitude + 180) / 6)
    for zone in (nearest, nearest - 1, nearest + 1):
        number = zone % 60 + 1
        south = latitude < 0
        off = utm(where, number, bool(south)) - centres[:, :2]
        if np.abs(off).max() < _AGREEING_M:
            crs = f"EPSG:{(32700 if south else 32600) + number}"
            return EarthPlace(crs, np.rint(np.median(centres, axis=0)), np.eye(3))
    return None


def utm(where: NDArray[np.float64], zone: int, south: bool) -> NDArray[np.float64]:
    """[N, 2] easting and northing of longitudes and latitudes [N, 2], degrees, on WGS 84.

    By the series of Krueger to the third power of the flattening (Karney, Transverse Mercator with
    an accuracy of a few nanometers, 2011, equations 7 to 14 and 35), good to a millimetre: to
    recognise a zone.
    """
    n = _FLATTENING / (2 - _FLATTENING)
    eccentricity = 2 * np.sqrt(n) / (1 + n)
    sine = np.sin(np.radians(where[:, 1]))
    across = np.radians((where[:, 0] - (6 * zone - 183) + 180) % 360 - 180)
    tangent = np.sinh(np.arctanh(sine) - eccentricity * np.arctanh(eccentricity * sine))
    sphere = np.arctan2(tangent, np.cos(across)) + 1j * np.arctanh(
        np.sin(across) / np.hypot(1, tangent)
    )
    factors = (
        n / 2 - 2 / 3 * n**2 + 5 / 16 * n**3,
        13 / 48 * n**2 - 3 / 5 * n**3,
        61 / 240 * n**3,
    )
    plane = sphere + sum(f * np.sin(2 * k * sphere) for k, f in enumerate(factors, 1))
    plane *= _UTM_SCALE * _HALF_AXIS / (1 + n) * (1 + n**2 / 4 + n**4 / 64)
    return np.stack([500_000 + plane.imag, (10_000_000 if south else 0) + plane.real], axis=1)
