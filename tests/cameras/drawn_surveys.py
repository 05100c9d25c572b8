"""Cameras as survey programs and phones export them, as in `drawn`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tests.cameras import drawn
from tests.cameras.drawn import (
    FOCAL,
    HEIGHT,
    NAMES,
    POSES,
    WIDTH,
    Project,
    draw,
    opengl_pose,
)


def _pinhole(pose: NDArray[np.float64]) -> Project:
    """Of a camera to world, y up and z backward, with the principal point at 157, 123."""

    def project(points: NDArray[np.float64]) -> NDArray[np.float64]:
        at = (points - pose[:3, 3]) @ pose[:3, :3]
        d = at / -at[:, 2:]
        return np.stack([d[:, 0] * FOCAL + 157, -d[:, 1] * FOCAL + 123], axis=1)

    return project


def arkit(folder: Path) -> Path:
    """3D Scanner App: matrices by rows; a frame without picture between the others."""
    poses = [opengl_pose(pose) for pose in POSES]
    draw(folder, [_pinhole(pose) for pose in poses])
    for number, (name, pose) in enumerate(zip(NAMES, poses, strict=True)):
        (folder / name).rename(folder / f"frame_{6 * number:05}.png")
        frame = {
            "cameraPoseARFrame": pose.ravel().tolist(),
            "intrinsics": [FOCAL, 0, 156.5, 0, FOCAL, 122.5, 0, 0, 1],
            "time": 0.1 * number,
        }
        (folder / f"frame_{6 * number:05}.json").write_text(json.dumps(frame))
    (folder / "frame_00003.json").write_text(json.dumps(frame))
    return folder


def polycam(folder: Path) -> Path:
    """Polycam's keyframes: corrected cameras beside those of ARKit, which are off."""
    poses = [opengl_pose(pose) for pose in POSES]
    draw(folder / "keyframes" / "corrected_images", [_pinhole(pose) for pose in poses])
    draw(folder / "keyframes" / "images", [_pinhole(pose) for pose in poses])
    for kind, off in (("cameras", 0.3), ("corrected_cameras", 0.0)):
        (folder / "keyframes" / kind).mkdir()
        for name, pose in zip(NAMES, poses, strict=True):
            camera: dict[str, Any] = {f"t_{i}{j}": pose[i, j] for i in range(3) for j in range(4)}
            camera |= {"fx": FOCAL, "fy": FOCAL, "cx": 157, "cy": 123, "blur_score": 100.0}
            camera |= {"width": WIDTH, "height": HEIGHT}
            camera["t_03"] += off
            file = folder / "keyframes" / kind / name.replace(".png", ".json")
            file.write_text(json.dumps(camera))
    return folder


MADE = {
    **drawn.MADE,
    "arkit": arkit,
}
