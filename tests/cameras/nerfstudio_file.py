"""Writes transforms.json as nerfstudio's own import from COLMAP does.

The world is z up: our y-down world rotated by `applied_transform` (x, z, -y).
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from plyfile import PlyData, PlyElement

from stages.base.atomic import replacing
from stages.cameras.nerfstudio import OPENGL_FROM_OURS
from stages.scene import View

APPLIED_TRANSFORM = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
_LENS = ("w", "h", "fl_x", "fl_y", "cx", "cy")


def write(
    path: Path,
    views: Sequence[View],
    pictures: Path,
    points: NDArray[np.float64] | None = None,
    colours: NDArray[np.uint8] | None = None,
) -> None:
    """Write the views. The points go into a .ply of the same name beside the file: nerfstudio
    initialises splats from it. Raises SplatError if a file cannot be written.

    Args:
        path: of transforms.json.
        views: to write.
        pictures: folder that `View.image` is relative to; the file names pictures relative to its
            own folder.
        points: [P, 3].
        colours: [P, 3].
    """
    data: dict[str, Any] = {
        "camera_model": "PINHOLE",
        "applied_transform": np.hstack([APPLIED_TRANSFORM, np.zeros((3, 1))]).tolist(),
    }
    lenses = [_lens(view) for view in views]
    shared = all(lens == lenses[0] for lens in lenses)
    if shared:
        data |= lenses[0]
    if points is not None and colours is not None and len(points):
        beside = path.with_suffix(".ply")
        _write_points(beside, points @ APPLIED_TRANSFORM.T, colours)
        data["ply_file_path"] = beside.name
    data["frames"] = [
        {
            "file_path": _seen_from(path.parent, pictures / view.image),
            **({} if shared else lens),
            "transform_matrix": _saved_pose(view.camera.world_to_camera).tolist(),
        }
        for view, lens in zip(views, lenses, strict=True)
    ]
    with replacing(path) as partial:
        partial.write_text(json.dumps(data, indent=1, ensure_ascii=False), encoding="utf-8")


def _lens(view: View) -> dict[str, float]:
    camera = view.camera
    lens = (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
    return dict(zip(_LENS, lens, strict=True))


def _saved_pose(world_to_camera: NDArray[np.float64]) -> NDArray[np.float64]:
    """[4, 4] `transform_matrix` of a camera."""
    rotation, translation = world_to_camera[:3, :3], world_to_camera[:3, 3]
    pose = np.eye(4)
    pose[:3, :3] = APPLIED_TRANSFORM @ rotation.T @ OPENGL_FROM_OURS
    pose[:3, 3] = APPLIED_TRANSFORM @ (-rotation.T @ translation)
    return pose + 0.0  # no -0.0


def _seen_from(folder: Path, picture: Path) -> str:
    try:
        return Path(os.path.relpath(picture, folder)).as_posix()
    except ValueError:  # another drive
        return picture.resolve().as_posix()


def _write_points(path: Path, points: NDArray[np.float64], colours: NDArray[np.uint8]) -> None:
    names = [(name, "<f4") for name in "xyz"] + [(name, "u1") for name in ("red", "green", "blue")]
    rows = np.empty(len(points), names)
    for axis, name in enumerate("xyz"):
        rows[name] = points[:, axis]
    for channel, name in enumerate(("red", "green", "blue")):
        rows[name] = colours[:, channel]
    with replacing(path) as partial:
        PlyData([PlyElement.describe(rows, "vertex")], byte_order="<").write(str(partial))
