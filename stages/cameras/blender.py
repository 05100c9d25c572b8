"""The layout of the synthetic NeRF scenes: transforms_train.json, _val and _test in one folder.

https://github.com/bmild/nerf: each file is a transforms.json with an angle of view and no sizes,
pictures are named without their suffix, and the files are the benchmark's own split.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from stages.cameras import nerfstudio
from stages.cameras.camera_file import CameraFile, FilePoints

_SPLITS = ("train", "val", "test")


def locate(path: Path) -> Path | None:
    """The folder, if it holds transforms_train.json."""
    return path if _part(path, "train").is_file() else None


def read(folder: Path) -> CameraFile:
    """The cameras of all files that exist; the role of a view is its split. A picture that is
    missing, as validation pictures often are, gets the size of the first training picture. Raises
    SplatError "cameras-unreadable"."""
    first = nerfstudio.read(_part(folder, "train"))
    size = first.views[0].camera.width, first.views[0].camera.height
    others = [name for name in _SPLITS[1:] if _part(folder, name).is_file()]
    parts = [("train", first)] + [
        (name, nerfstudio.read(_part(folder, name), size)) for name in others
    ]
    return CameraFile(
        tuple(replace(view, role=name) for name, part in parts for view in part.views),
        folder,
        tuple(lens for _, part in parts for lens in part.lenses),
        z_up=all(part.z_up for _, part in parts),
    )


def read_points(folder: Path) -> FilePoints | None:
    """The points that the training file names, if any. Raises SplatError "cameras-unreadable"."""
    return nerfstudio.read_points(_part(folder, "train"))


def _part(folder: Path, name: str) -> Path:
    return folder / f"transforms_{name}.json"
