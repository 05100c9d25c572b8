"""Metashape's cameras ("Export Cameras", Agisoft XML); its manual's appendix "Camera models".

A camera's transform is camera to world with our axes; the world is the chunk's own. Principal
points are relative to the middle of the picture; P1 and P2 are OpenCV's p2 and p1.

The chunk's transform, if it has one, leads to geocentric coordinates in metres, or to local
coordinates (z up) whose unit the chunk's reference names. An identity transform says nothing.
"""

from __future__ import annotations

import re
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

from stages.base.bad_files import CAMERAS, BadFileError, reading
from stages.cameras.camera_file import (
    NO_GEOREFERENCE,
    ROTATION_TOLERANCE,
    CameraFile,
    Georeference,
    camera_file,
    poses_of,
)
from stages.cameras.lens import Lens
from stages.cameras.xml_file import parsed
from stages.scene.place import GEOGRAPHIC, EarthPlace, east_north_up, geodetic

_EARTH_RADII = (6.2e6, 6.5e6)  # metres, of places where photographs are taken
_SOURCE = "the chunk's transform"
_KINDS = {"frame": "perspective", "fisheye": "fisheye"}


def read(path: Path) -> CameraFile:
    """The cameras that were aligned. Raises SplatError "cameras-unreadable"."""
    with reading(path, CAMERAS):
        root = parsed(path)
        optics = {
            sensor.get("id", ""): _optics(sensor)
            for sensor in root.iter("sensor")
            if sensor.find("calibration") is not None
        }
        aligned = [camera for camera in root.iter("camera") if camera.find("transform") is not None]
        missing = {camera.get("sensor_id", "") for camera in aligned} - optics.keys()
        if missing:
            raise BadFileError(f"there is no calibrated sensor {min(missing)[:80]!r}")
        mine = [optics[camera.get("sensor_id", "")] for camera in aligned]
        texts = [(camera.findtext("transform") or "").split() for camera in aligned]
        poses = np.array(texts, np.float64).reshape(-1, 4, 4)
        rotations = poses[:, :3, :3].transpose(0, 2, 1)
        names = [camera.get("label", "") for camera in aligned]
        moved = poses_of(rotations, poses[:, :3, 3])
        return camera_file(path.parent, names, mine, moved, _georeference(root))


def _georeference(root: Element) -> Georeference:
    """From the transform of a chunk or component, if there is exactly one."""
    every = [e for e in root.iter("transform") if e.find("scale") is not None]
    if len(every) != 1:
        return NO_GEOREFERENCE
    turn = _numbers(every[0], "rotation", 9).reshape(3, 3)
    shift, (scale,) = _numbers(every[0], "translation", 3), _numbers(every[0], "scale", 1)
    if scale <= 0 or np.abs(turn @ turn.T - np.eye(3)).max() > ROTATION_TOLERANCE:
        raise BadFileError("the chunk's transform is not a rotation and scale")
    if _EARTH_RADII[0] < np.linalg.norm(shift) < _EARTH_RADII[1]:
        offset = geodetic(shift)
        axes = east_north_up(offset) @ turn
        place = EarthPlace(GEOGRAPHIC, offset, float(scale) * axes)
        return Georeference(float(scale), axes, _SOURCE, place)
    reference = (root.findtext(".//chunk/reference") or root.findtext("reference") or "").strip()
    unit = re.search(r'UNIT\["[^"]*",\s*([0-9.]+)', reference)
    changes = scale != 1.0 or shift.any() or (turn != np.eye(3)).any()
    if not (reference.startswith("LOCAL_CS") and unit and changes):
        return NO_GEOREFERENCE
    return Georeference(float(scale) * float(unit[1]), turn, _SOURCE)


def _numbers(transform: Element, name: str, count: int) -> NDArray[np.float64]:
    values = np.array((transform.findtext(name) or "").split(), np.float64)
    if len(values) != count or not np.isfinite(values).all():
        raise BadFileError(f"the {name} of its chunk does not have {count} numbers")
    return values


def _optics(sensor: Element) -> tuple[list[float], Lens]:
    """(width, height, fx, fy, cx, cy in pixels; the lens) of the adjusted calibration, if there is
    one."""
    every = sensor.findall("calibration")
    calibration = next((c for c in every if c.get("class") == "adjusted"), every[0])
    resolution = calibration.find("resolution")
    kind = sensor.get("type", "frame")
    if kind not in _KINDS or resolution is None:
        raise BadFileError(f"a sensor of type {kind[:40]} has no known lens model")

    def value(name: str) -> float:
        return float(calibration.findtext(name) or 0.0)

    width, height = float(resolution.get("width", 0)), float(resolution.get("height", 0))
    if value("p3") or value("p4"):
        raise BadFileError("a lens has terms p3 and p4, which are not supported")
    k1, k2, k3, k4, p1, p2 = (value(name) for name in ("k1", "k2", "k3", "k4", "p1", "p2"))
    focal = value("f")
    across = focal + value("b1")
    numbers = [width, height, across, focal]
    centre = [width / 2 + value("cx"), height / 2 + value("cy")]
    skew = value("b2") / across if across > 0 else 0.0
    lens = Lens(_KINDS[kind], (k1, k2, k3, k4), tangential=(p2, p1), skew=skew)
    return numbers + centre, lens
