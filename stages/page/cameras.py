"""Cameras in the conventions of the page.

The viewer rotates content by 180 degrees about z, so that y down becomes y up; cameras are rotated
with it. Its own camera has x right, y up and looks along -z.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.scene import Camera, Splats, View, split_held_out
from stages.scene.framing import first_camera, median_depth
from stages.scene.rotations import matrices_of, quaternions_of

_LENS = ("width", "height", "fx", "fy", "cx", "cy")
_VIEWER_FROM_WORLD = np.diag([-1.0, -1.0, 1.0])
_CAMERA_FROM_VIEWERS = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True)
class PageCamera:
    """A camera of the page. photo: the address of its photograph; "" without one. held_out:
    whether the view was held out from training."""

    name: str
    camera: Camera
    photo: str = ""
    held_out: bool = False


def page_cameras(views: Sequence[View], splats: Splats) -> tuple[PageCamera, ...]:
    """The cameras of the capture, sorted by name, without photographs; the first camera of the
    splats if there are none."""
    if not views:
        return (PageCamera("first view", first_camera(splats)),)
    held = {view.name for view in split_held_out(tuple(views))[1]}
    ordered = sorted(views, key=lambda view: view.name)
    return tuple(PageCamera(view.name, view.camera, held_out=view.name in held) for view in ordered)


def as_plain(shot: PageCamera, means: NDArray[np.floating]) -> dict[str, Any]:
    """A camera as JSON values: position and target in the viewer's world, rotation x, y, z, w from
    the viewer's camera to its world, intrinsics in pixels as in `Camera`. means [N, 3]: the splats
    it looks at, for the distance of the target."""
    camera = shot.camera
    depth = median_depth(camera, means)
    rotation = _VIEWER_FROM_WORLD @ camera.world_to_camera[:3, :3].T @ _CAMERA_FROM_VIEWERS
    return {
        "name": shot.name,
        "photo": shot.photo,
        "held_out": shot.held_out,
        **{name: getattr(camera, name) for name in _LENS},
        "position": _plain(_VIEWER_FROM_WORLD @ camera.centre),
        "target": _plain(_VIEWER_FROM_WORLD @ (camera.centre + depth * camera.forward)),
        "rotation": _plain(quaternions_of(rotation)[[1, 2, 3, 0]]),
    }


def camera_of(shot: Mapping[str, Any]) -> Camera:
    """The camera that `as_plain` returned as `shot`. Raises ValueError, or what damaged values
    cause."""
    pose = np.eye(4)
    turn = matrices_of(np.array(shot["rotation"], np.float64)[[3, 0, 1, 2]])
    pose[:3, :3] = _VIEWER_FROM_WORLD @ turn @ _CAMERA_FROM_VIEWERS
    pose[:3, 3] = _VIEWER_FROM_WORLD @ np.array(shot["position"], np.float64)
    width, height, fx, fy, cx, cy = lens = [float(shot[name]) for name in _LENS]
    if not np.isfinite([*lens, *pose.flat]).all() or min(width, height, fx, fy) <= 0:
        raise ValueError("a camera of it has values that no camera has")
    return Camera(round(width), round(height), fx, fy, cx, cy, np.asarray(np.linalg.inv(pose)))


def _plain(values: NDArray[np.floating]) -> list[float]:
    return [round(float(value), 9) for value in values]
