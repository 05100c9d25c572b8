"""RealityScan's (RealityCapture's) metadata: an .xmp beside each photograph.

Rotation is world to camera by rows, with our axes; Position is the camera's centre. The focal
length is in units of 1/36 of the longer side, the principal point in units of the longer side,
relative to the middle. The coefficients of Brown's models are k1 to k4, t1 and t2, as OpenCV's.
Each value is an attribute or an element, and one export holds both kinds.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

from stages.base.bad_files import CAMERAS, BadFileError, reading
from stages.cameras.camera_file import (
    CameraFile,
    camera_file,
    picture_beside,
    poses_of,
    stored_size,
)
from stages.cameras.lens import PINHOLE, Lens
from stages.cameras.xml_file import parsed

_LONGER_SIDE = 36.0
_NAMESPACE = "{http://www.capturingreality.com/ns/xcr/1.1#}"
_START = 4096  # bytes in which the namespace of RealityScan is declared


def locate(path: Path) -> Path | None:
    """The folder `path`, if it holds such an .xmp."""
    if not path.is_dir():
        return None
    first = next(iter(sorted(path.glob("*.xmp"))), None)
    if first is None or not first.is_file():
        return None
    with first.open("rb") as file:
        return path if b"capturingreality" in file.read(_START) else None


def read(path: Path) -> CameraFile:
    """The cameras that have a pose; their pictures are beside the files. Raises SplatError
    "cameras-unreadable"."""
    names, optics, poses = [], [], []
    for file in sorted(path.glob("*.xmp")):
        with reading(file, CAMERAS):
            about = _description(file)
            rotation, position = _values(about, "Rotation"), _values(about, "Position")
            if rotation is None or position is None:
                continue  # not registered: it has a calibration only
            if len(rotation) != 9 or len(position) != 3:
                raise BadFileError("its pose is not 9 and 3 numbers")
            picture = picture_beside(file)
            if picture is None:
                raise BadFileError("its picture is not beside it, and the size of that is needed")
            names.append(picture.name)
            optics.append((_intrinsics(about, *stored_size(picture)), _lens(about)))
            poses.append(poses_of(rotation.reshape(1, 3, 3), position.reshape(1, 3))[0])
    with reading(next(iter(sorted(path.glob("*.xmp")))), CAMERAS):
        return camera_file(path, names, optics, np.array(poses).reshape(-1, 3, 4))


def _description(path: Path) -> Element:
    root = parsed(path)
    for element in root.iter():
        if any(name.startswith(_NAMESPACE) for name in element.attrib):
            return element
    raise BadFileError("it holds nothing of RealityScan's")


def _text(about: Element, name: str) -> str | None:
    return about.get(_NAMESPACE + name) or about.findtext(_NAMESPACE + name)


def _values(about: Element, name: str) -> NDArray[np.float64] | None:
    text = _text(about, name)
    return None if text is None else np.array(text.split(), np.float64)


def _intrinsics(about: Element, width: int, height: int) -> list[float]:
    """width, height, fx, fy, cx, cy in pixels."""
    longer = max(width, height)
    focal = float(_text(about, "FocalLength35mm") or "nan") / _LONGER_SIDE * longer
    ratio = float(_text(about, "AspectRatio") or 1)
    u, v = (float(_text(about, f"PrincipalPoint{axis}") or 0) for axis in "UV")
    centre = [width / 2 + u * longer, height / 2 + v * longer]
    return [width, height, focal, focal * ratio, *centre]


def _lens(about: Element) -> Lens:
    terms = _values(about, "DistortionCoeficients")  # as the program spells it
    if terms is None or not terms.any():
        return PINHOLE
    model = str(_text(about, "DistortionModel"))
    if not model.startswith("brown") or len(terms) != 6 or not np.isfinite(terms).all():
        raise BadFileError(
            f"its distortion model {model[:40]} is not supported",
            hint="Choose one of Brown's models in RealityScan's alignment settings, and export "
            "again.",
        )
    k1, k2, k3, k4, t1, t2 = terms.tolist()
    return Lens(radial=(k1, k2, k3, k4), tangential=(t1, t2))
