"""Pix4D's Open Photogrammetry Format, version 1: https://pix4d.github.io/opf-spec/

project.opf names other files of JSON: the pictures, the calibrated cameras, the sizes of pictures,
and the scene reference frame. A camera's orientation is Rx(omega) Ry(phi) Rz(kappa), degrees,
camera to world, with OpenGL's axes. The world is easting, northing and height plus the frame's
shift.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from stages.base.bad_files import CAMERAS, BadFileError, reading
from stages.cameras.camera_file import (
    NO_GEOREFERENCE,
    CameraFile,
    Georeference,
    camera_file,
    check_inside,
    json_of,
    poses_of,
)
from stages.cameras.lens import Lens
from stages.cameras.nerfstudio import OPENGL_FROM_OURS
from stages.scene.place import EarthPlace

_SOURCE = "the scene reference frame"
_CODE = re.compile(r'EPSG:([0-9]{4,6})\b|ID\["EPSG",\s*([0-9]{4,6})\]')
_UNIT = re.compile(r'\b(?:LENGTH)?UNIT\["[^"]*",\s*([0-9.eE+-]+)')
_TOKEN = re.compile(r'"[^"]*"|[\[\],]')  # of WKT; a doubled quote gives two strings side by side
_UTM = re.compile("32[67](?:0[1-9]|[1-5][0-9]|60)|258(?:2[89]|3[0-8])")  # of WGS 84 and ETRS89


def locate(path: Path) -> Path | None:
    """A .opf, itself or the only one in the folder `path`."""
    if path.is_dir():
        inside = sorted(path.glob("*.opf"))
        return inside[0] if len(inside) == 1 else None
    return path if path.suffix.lower() == ".opf" else None


def read(path: Path) -> CameraFile:
    """The calibrated cameras. Raises SplatError "cameras-unreadable"."""
    with reading(path, CAMERAS):
        project = json_of(path)
        if project.get("format") != "application/opf-project+json":
            raise BadFileError("it is not a project of the Open Photogrammetry Format")
        pictures = {
            int(camera["id"]): _name(camera["uri"])
            for part in _parts(path, project, "camera_list")
            for camera in part["cameras"]
        }
        sizes = {
            int(sensor["id"]): sensor["image_size_px"]
            for part in _parts(path, project, "input_cameras")
            for sensor in part["sensors"]
        }
        calibrated = list(_parts(path, project, "calibrated_cameras", "calibration"))
        if len(calibrated) != 1:
            raise BadFileError(f"it has {len(calibrated)} calibrations, wanted one")
        cameras = calibrated[0]["cameras"]
        optics = {
            int(sensor["id"]): _optics(sensor["internals"], sizes.get(int(sensor["id"])))
            for sensor in calibrated[0]["sensors"]
        }
        mine = [optics[_known(optics, camera["sensor_id"], "sensor")] for camera in cameras]
        names = [pictures[_known(pictures, camera["id"], "picture")] for camera in cameras]
        angles = np.array([camera["orientation_deg"] for camera in cameras], np.float64)
        centres = np.array([camera["position"] for camera in cameras], np.float64).reshape(-1, 3)
        poses = poses_of(_world_to_camera(angles.reshape(-1, 3)), centres)
        frames = list(_parts(path, project, "scene_reference_frame"))
        ground = _georeference(frames[0]) if len(frames) == 1 else NO_GEOREFERENCE
        return camera_file(path.parent, names, mine, poses, ground)


def files(path: Path) -> list[Path]:
    """The files of JSON in and below the project's folder."""
    return [path, *sorted(path.parent.rglob("*.json"))]


def _parts(path: Path, project: Any, form: str, kind: str = "") -> Iterator[dict[str, Any]]:
    """The JSON of this form ("camera_list") in the items of this kind, mostly of the same name."""
    wanted = f"application/opf-{form.replace('_', '-')}+json"
    for item in project["items"]:
        if item["type"] != (kind or form):
            continue
        for resource in item["resources"]:
            if resource["format"] != wanted:
                continue
            name = unquote(str(resource["uri"]))
            check_inside(path.parent, name, path.parent)
            file = path.parent / name
            if not file.is_file():
                raise BadFileError(f"it names {name[:80]}, which is not there")
            with reading(file, CAMERAS):
                content: dict[str, Any] = json_of(file)
            yield content


def _name(uri: str) -> str:
    """The path of a picture; only the first page of several is a photograph."""
    place, _, page = str(uri).partition("#")
    if page not in ("", "page=0"):
        return f"{unquote(place)}#{page}"
    return re.sub(r"^file:/*", "", unquote(place))


def _known(table: dict[int, Any], number: Any, what: str) -> int:
    if int(number) not in table:
        raise BadFileError(f"a camera's {what} {int(number)} is not listed")
    return int(number)


def _optics(internals: dict[str, Any], size: Any) -> tuple[list[float], Lens]:
    """(width, height, fx, fy, cx, cy in pixels; the lens).

    A fisheye's radius is a polynomial of the angle from the axis in quarter turns, whose first two
    coefficients are 0 and 1; an affine matrix by rows turns it into pixels.
    """
    kind = str(internals["type"])
    if kind not in ("perspective", "fisheye"):
        raise BadFileError(f"a lens of type {kind[:40]} is not supported")
    if size is None:
        raise BadFileError("the size of a sensor's pictures is not in its input cameras")
    centre = [float(value) for value in internals["principal_point_px"]]
    if kind == "fisheye":
        c, d, e, f = (float(value) for value in internals["affine"])
        zero, one, *terms = (float(value) for value in internals["polynomial"])
        if not np.isfinite([c, d, e, f, *terms]).all() or (zero, one, e) != (0.0, 1.0, 0.0):
            raise BadFileError("a fisheye lens has an offset or a shear that is not supported")
        lens = Lens("polynomial fisheye", parameters=tuple(terms), skew=d / c if c else 0.0)
        return [*map(float, size), c * 2 / math.pi, f * 2 / math.pi, *centre], lens
    focal = float(internals["focal_length_px"])
    r1, r2, r3 = (float(value) for value in internals["radial_distortion"])
    t1, t2 = (float(value) for value in internals["tangential_distortion"])
    if not np.isfinite([r1, r2, r3, t1, t2]).all():
        raise BadFileError("a lens has a parameter that is not a number")
    lens = Lens(radial=(r1, r2, r3), tangential=(t1, t2))
    return [*map(float, size), focal, focal, *centre], lens


def _world_to_camera(angles: NDArray[np.float64]) -> NDArray[np.float64]:
    """[V, 3, 3], with our axes of the camera, of omega, phi and kappa [V, 3], degrees."""
    to_world = Rotation.from_euler("XYZ", angles, degrees=True).as_matrix()
    return np.asarray(OPENGL_FROM_OURS @ to_world.transpose(0, 2, 1))


def _georeference(frame: dict[str, Any]) -> Georeference:
    """In the unit of the frame, with a place where it is a projected system in metres."""
    definition = str(frame["crs"]["definition"])
    to_canonical = frame["base_to_canonical"]
    shift = np.array(to_canonical["shift"], np.float64).reshape(3)
    if not np.isfinite(shift).all():
        raise BadFileError("the shift of its reference frame is not three numbers")
    if [float(value) for value in to_canonical["scale"]] != [1.0, 1.0, 1.0]:
        return NO_GEOREFERENCE  # axes of different units
    if definition.startswith("EPSG:"):
        return _of_code(definition, -shift)
    system = _cartesian(definition)
    parts = _inside(system)
    axes = [part for part in parts if part.startswith(("AXIS[", "LENGTHUNIT[", "UNIT["))]
    units = {float(unit) for part in axes for unit in _UNIT.findall(part)}
    codes = [part for part in parts if _CODE.fullmatch(part)]
    if system.startswith("PROJ") and codes and units in (set(), {1.0}):
        return _of_code(codes[-1], -shift, known=bool(units))
    (factor,) = units if len(units) == 1 else (0.0,)
    return Georeference(factor, np.eye(3), _SOURCE) if 0 < factor < math.inf else NO_GEOREFERENCE


def _of_code(text: str, offset: NDArray[np.float64], known: bool = False) -> Georeference:
    """Of the projected system whose code of EPSG the text names; without place if it is not in
    metres. known: that it is in metres. Otherwise only UTM's is known without pyproj."""
    found = _CODE.match(text)
    code = (found[1] or found[2]) if found else ""
    factor = 1.0 if known or _UTM.fullmatch(code) else _metres_per_unit(code)
    if not factor:
        return NO_GEOREFERENCE
    place = EarthPlace(f"EPSG:{code}", offset, np.eye(3)) if factor == 1.0 else None
    return Georeference(factor, np.eye(3), _SOURCE, place)


def _metres_per_unit(code: str) -> float:
    """Of a projected system; 0 if it is none, or if it is not known here."""
    try:
        import pyproj
    except ImportError:
        return 0.0
    try:
        system = pyproj.CRS.from_user_input(f"EPSG:{code}")
    except pyproj.exceptions.CRSError:
        return 0.0
    units = {axis.unit_conversion_factor for axis in system.axis_info}
    return float(*units) if system.is_projected and len(units) == 1 else 0.0


def _cartesian(wkt: str) -> str:
    """The projected or engineering system of WKT, which may be part of a compound one; "" if there
    is none."""
    wkt = wkt.strip()
    parts = _inside(wkt) if wkt.startswith("COMPOUNDCRS") else [wkt]
    return next((part for part in parts if part.startswith(("PROJ", "ENG"))), "")


def _inside(wkt: str) -> list[str]:
    """What is directly inside an element of WKT, in its order."""
    depth = start = 0
    found: list[str] = []
    for token in _TOKEN.finditer(wkt):
        depth += {"[": 1, "]": -1}.get(token[0], 0)
        if token[0] == "[" and depth == 1:
            start = token.end()
        elif (token[0] == "," and depth == 1) or (token[0] == "]" and depth == 0):
            found.append(wkt[start : token.start()].strip())
            start = token.end()
    return found
