"""Metashape's cameras ("Export Cameras", Agisoft XML); its manual's appendix "Camera models".

A camera's transform is camera to component with our axes. A chunk has one component for each part
that was aligned by itself; our world is that of the component with most cameras. Principal points
are relative to the middle of the picture; P1 and P2 are OpenCV's p2 and p1.

A component's transform, if it has one, leads to geocentric coordinates in metres, or to local
coordinates (z up) whose unit the chunk's reference names. An identity transform says nothing.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple
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


class _Transform(NamedTuple):
    """Takes a component's position x to `scale` `turn` x + `shift` of the chunk's reference."""

    turn: NDArray[np.float64]
    shift: NDArray[np.float64]
    scale: float

    @property
    def changes(self) -> bool:
        return bool(self.scale != 1.0 or self.shift.any() or (self.turn != np.eye(3)).any())


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
        world = _place_together(root, [c.get("component_id", "") for c in aligned], poses)
        rotations = poses[:, :3, :3].transpose(0, 2, 1)
        names = [camera.get("label", "") for camera in aligned]
        moved = poses_of(rotations, poses[:, :3, 3])
        return camera_file(path.parent, names, mine, moved, _georeference(root, world))


def _place_together(
    root: Element, components: Sequence[str], poses: NDArray[np.float64]
) -> _Transform | None:
    """Move camera-to-component matrices [V, 4, 4] into the world of the component with most of
    them. Returns its transform, None if it has none. Raises BadFileError if the file does not say
    where components are relative to each other.

    components: V, that of each camera.
    """
    counts = Counter(components)
    if len(counts) < 2:
        return _transform(root, next(iter(counts), ""))
    largest = counts.most_common(1)[0][0]
    every = {component: _transform(root, component) for component in counts}
    placed = {component: one for component, one in every.items() if one is not None}
    if len(placed) < len(counts) or sum(not one.changes for one in placed.values()) > 1:
        raise BadFileError(
            f"its cameras belong to {len(counts)} components, and it does not say where these are "
            "relative to each other",
            hint="Align or merge the components in Metashape, or remove the cameras of all but one "
            "from the alignment, and export again.",
        )
    world = placed[largest]
    for component, own in placed.items():
        if component == largest:
            continue
        mine = np.array([one == component for one in components])
        turn, scale = world.turn.T @ own.turn, own.scale / world.scale
        shift = world.turn.T @ (own.shift - world.shift) / world.scale
        with np.errstate(all="ignore"):  # `camera_file` checks the result
            poses[mine, :3, 3] = scale * poses[mine, :3, 3] @ turn.T + shift
            poses[mine, :3, :3] = turn @ poses[mine, :3, :3]
    return world


def _transform(root: Element, component: str) -> _Transform | None:
    """That of the component, or of the chunk if it is the only one. "" is the component of cameras
    that name none."""
    every = [e for e in root.iter("transform") if e.find("scale") is not None]
    of_components = {e: c.get("id", "") for c in root.iter("component") for e in c if e in every}
    own = [e for e in every if of_components.get(e) == component]
    if not own and len(every) == 1 and (component == "" or every[0] not in of_components):
        own = every
    if len(own) != 1:
        return None
    turn = _numbers(own[0], "rotation", 9).reshape(3, 3)
    shift, (scale,) = _numbers(own[0], "translation", 3), _numbers(own[0], "scale", 1)
    if scale <= 0 or np.abs(turn @ turn.T - np.eye(3)).max() > ROTATION_TOLERANCE:
        raise BadFileError("the chunk's transform is not a rotation and scale")
    return _Transform(turn, shift, float(scale))


def _georeference(root: Element, world: _Transform | None) -> Georeference:
    """From the transform of the cameras' world, if it has one."""
    if world is None:
        return NO_GEOREFERENCE
    turn, shift, scale = world
    if _EARTH_RADII[0] < np.linalg.norm(shift) < _EARTH_RADII[1]:
        offset = geodetic(shift)
        axes = east_north_up(offset) @ turn
        place = EarthPlace(GEOGRAPHIC, offset, scale * axes)
        return Georeference(scale, axes, _SOURCE, place)
    reference = (root.findtext(".//chunk/reference") or root.findtext("reference") or "").strip()
    unit = re.search(r'UNIT\["[^"]*",\s*([0-9.]+)', reference)
    if not (reference.startswith("LOCAL_CS") and unit and world.changes):
        return NO_GEOREFERENCE
    return Georeference(scale * float(unit[1]), turn, _SOURCE)


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
