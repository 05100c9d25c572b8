"""OpenSfM's reconstruction.json, which ODM writes too: https://opensfm.org/docs/dataset.html

Rotations are axis-angle vectors, world to camera, with our axes. Focal lengths and principal points
are in units of the longer side, the latter relative to the picture's centre. Of several
reconstructions the largest is read. If reference_lla has a latitude and longitude, the world is in
metres east, north and up of it, as far as GPS is right; without GPS the reference is 0, 0.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from stages.base.bad_files import CAMERAS, BadFileError, reading
from stages.cameras.camera_file import (
    NO_GEOREFERENCE,
    CameraFile,
    FilePoints,
    Georeference,
    camera_file,
    file_points,
    json_of,
)
from stages.cameras.lens import Lens
from stages.scene import View
from stages.scene.place import GEOGRAPHIC, EarthPlace

_NAME = "reconstruction.json"
_PERSPECTIVE = ("perspective", "simple_radial", "radial", "brown")
_FISHEYE = ("fisheye", "fisheye_opencv")
_MAX_DOP = 1e4  # metres; OpenSfM writes 999,999 for no GPS
_MAX_RESIDUAL = 0.15  # of the spread of the cameras, as for GPS in Exif
_MIN_GPS = 3


def locate(path: Path) -> Path | None:
    """A .json that holds a list, itself or in the folder `path` or ODM's project `path`."""
    if path.is_dir():
        near = (path / _NAME, path / "opensfm" / _NAME)
        return next((file for file in near if file.is_file()), None)
    if path.suffix.lower() != ".json" or not path.is_file():
        return None
    with path.open("rb") as file:
        return path if file.read(64).lstrip(b"\xef\xbb\xbf \t\r\n")[:1] == b"[" else None


def read(path: Path) -> CameraFile:
    """The cameras of the largest reconstruction; pictures are in `images` beside the file. Raises
    SplatError "cameras-unreadable"."""
    with reading(path, CAMERAS):
        data = _largest(path)
        shots = data["shots"]
        optics = {name: _optics(camera) for name, camera in data["cameras"].items()}
        missing = {str(shot["camera"]) for shot in shots.values()} - optics.keys()
        if missing:
            raise BadFileError(f"there is no camera {min(missing)[:80]!r}")
        turns = np.array([shot["rotation"] for shot in shots.values()], np.float64).reshape(-1, 3)
        shifts = np.array([shot["translation"] for shot in shots.values()], np.float64)
        with np.errstate(all="ignore"):  # `camera_file` checks the result
            rotations = Rotation.from_rotvec(turns).as_matrix()
        poses = np.concatenate([rotations, shifts.reshape(-1, 3, 1)], axis=2)
        own = [optics[shot["camera"]] for shot in shots.values()]
        cameras = camera_file(path.parent / "images", list(shots), own, poses)
        return replace(cameras, georeference=_georeference(data, cameras.views))


def _georeference(data: Mapping[str, Any], views: tuple[View, ...]) -> Georeference:
    """In metres, if there is a reference and the GPS positions of shots agree with the cameras."""
    reference = data.get("reference_lla")
    if not isinstance(reference, dict):
        return NO_GEOREFERENCE
    if not (reference.get("latitude") or reference.get("longitude")):
        return NO_GEOREFERENCE
    shots = list(data["shots"].values())
    with_gps = [i for i, s in enumerate(shots) if float(s.get("gps_dop", 0.0)) < _MAX_DOP]
    rows = [i for i in with_gps if "gps_position" in shots[i]]
    if rows:
        there = np.array([shots[i]["gps_position"] for i in rows], np.float64).reshape(-1, 3)
        here = np.array([views[i].camera.centre for i in rows])
        apart = np.median(np.linalg.norm((there - here)[:, :2], axis=1))
        spread = np.linalg.norm((there - there.mean(axis=0))[:, :2], axis=1).mean()
        if len(rows) < _MIN_GPS or not apart <= _MAX_RESIDUAL * spread:
            return NO_GEOREFERENCE
    offset = [float(reference.get(key, 0.0)) for key in ("latitude", "longitude", "altitude")]
    place = EarthPlace(GEOGRAPHIC, np.array(offset), np.eye(3))
    return Georeference(1.0, np.eye(3), "the file's GPS reference", place)


def read_points(path: Path) -> FilePoints | None:
    """The points of the largest reconstruction. Raises SplatError "cameras-unreadable"."""
    with reading(path, CAMERAS):
        points = list((_largest(path).get("points") or {}).values())
        where = np.array([point["coordinates"] for point in points], np.float64).reshape(-1, 3)
        colours = np.array([point.get("color", (128,) * 3) for point in points], np.float64)
        return file_points(where, colours.reshape(-1, 3))


def _largest(path: Path) -> dict[str, Any]:
    data = json_of(path)
    if not isinstance(data, list) or not data:
        raise BadFileError("it holds no reconstruction")
    for part in data:
        whole = isinstance(part, dict) and isinstance(part.get("cameras"), dict)
        if not (whole and isinstance(part.get("shots"), dict)):
            raise BadFileError("a reconstruction lacks cameras or shots")
    largest: dict[str, Any] = max(data, key=lambda part: len(part["shots"]))
    return largest


def _optics(camera: Mapping[str, Any]) -> tuple[list[float], Lens]:
    """(width, height, fx, fy, cx, cy in pixels; the lens)."""
    width, height = float(camera["width"]), float(camera["height"])
    kind = str(camera.get("projection_type", "perspective"))
    if kind not in _PERSPECTIVE + _FISHEYE:
        raise BadFileError(
            f"its projection type {kind[:40]} cannot be undistorted to a pinhole camera"
        )
    side = max(width, height)
    fx = float(camera["focal_x"] if "focal_x" in camera else camera["focal"])
    fy = float(camera.get("focal_y", fx))
    cx, cy = float(camera.get("c_x", 0.0)), float(camera.get("c_y", 0.0))
    k = [float(camera.get(key, 0.0)) for key in ("k1", "k2", "k3", "k4")]
    p = float(camera.get("p1", 0.0)), float(camera.get("p2", 0.0))
    # Here pixel coordinates start at the corner of the first pixel, there at its centre.
    centre = (width / 2 + side * cx, height / 2 + side * cy)
    lens = Lens("fisheye" if kind in _FISHEYE else "perspective", tuple(k), tangential=p)
    return [width, height, side * fx, side * fy, *centre], lens
