"""What a file of cameras holds, and what all of them must pass.

What is read comes in our own conventions: world to camera, x right, y down, z forward. The world
is the file's own; see each module for what it does to it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.base.bad_files import BadFileError
from stages.cameras.lens import Lens
from stages.scene import Camera, View

LARGEST_FILE = 1 << 30  # bytes; cameras and points of thousands of photographs have fewer
LARGEST_SIDE = 100_000  # pixels; no lens shows more
FARTHEST = 1e12  # world units; squares of it are still far from overflowing
ROTATION_TOLERANCE = 1e-3  # of R^T R: three decimals of text; beyond, it is not a rotation
_ROUNDED = 1e-9  # of R^T R: more than float64 leaves


@dataclass(frozen=True)
class Georeference:
    """What a file says of its world. metres: of one unit; 0 where it does not say. axes [3, 3]:
    rows point east, north and up in it; None likewise. said_by: in words."""

    metres: float = 0.0
    axes: NDArray[np.float64] | None = None
    said_by: str = ""


NO_GEOREFERENCE = Georeference()


@dataclass(frozen=True)
class CameraFile:
    """views: pinhole cameras, in the file's order; their role is that in the file's own split.
    folder: where `View.image` starts. lenses [V]: what bends each picture besides."""

    views: tuple[View, ...]
    folder: Path
    lenses: tuple[Lens, ...]
    ground: Georeference = NO_GEOREFERENCE

    @property
    def distorted(self) -> int:
        """How many views have a lens that distorts."""
        return sum(lens.distorts for lens in self.lenses)


@dataclass(frozen=True)
class FilePoints:
    """A camera file's sparse points, in the world of its cameras. points [P, 3], colours [P, 3]
    uint8, errors_px [P], tracks [P] views that see each; 0 where the file does not say."""

    points: NDArray[np.float64]
    colours: NDArray[np.uint8]
    errors_px: NDArray[np.float64]
    tracks: NDArray[np.int32]


def make_views(
    names: Sequence[str],
    sizes: NDArray[np.floating],
    intrinsics: NDArray[np.float64],
    world_to_camera: NDArray[np.float64],
    images: Sequence[str] | None = None,
) -> tuple[View, ...]:
    """Views of plain arrays. names [V]; images [V], if they differ; sizes [V, 2] width and height;
    intrinsics [V, 4] fx, fy, cx, cy; world_to_camera [V, 3 or 4, 4], rounding in its rotation
    taken out. Raises BadFileError for what no camera can be."""
    if not len(names):
        raise BadFileError("it holds no camera")
    poses = np.asarray(world_to_camera, np.float64)[:, :3]
    _refuse(names, ~((sizes >= 1) & (sizes <= LARGEST_SIDE)).all(1), "a size in pixels")
    bad = ~np.isfinite(intrinsics).all(1) | (intrinsics[:, :2] <= 0).any(1)
    _refuse(names, bad, "a focal length and a principal point")
    _refuse(names, ~(np.abs(poses) < FARTHEST).all((1, 2)), "a position and a direction")
    rotations = poses[:, :, :3]
    error = np.abs(rotations.transpose(0, 2, 1) @ rotations - np.eye(3)).max((1, 2))
    _refuse(
        names, (error > ROTATION_TOLERANCE) | (np.linalg.det(rotations) <= 0), "a rotation matrix"
    )
    rough = error > _ROUNDED
    left, _, right = np.linalg.svd(rotations[rough])
    matrices = np.tile(np.eye(4), (len(names), 1, 1))
    matrices[:, :3] = poses
    matrices[rough, :3, :3] = left @ right
    return tuple(
        View(
            name=name,
            image=image,
            camera=Camera(int(size[0]), int(size[1]), *lens.tolist(), matrix),  # type: ignore[call-arg]
        )
        for name, image, size, lens, matrix in zip(
            names, images or names, sizes, intrinsics, matrices, strict=True
        )
    )


def content_of(path: Path) -> bytes:
    """All of a file, unless it is too large for any cameras: a parser would want many times that
    much memory. Raises BadFileError."""
    size = path.stat().st_size
    if size > LARGEST_FILE:
        raise BadFileError(f"it has {size / 1e9:.1f} GB, and no cameras take more than 1.1")
    return path.read_bytes()


def size_of_picture(folder: Path, name: str) -> tuple[int, int]:
    """(width, height) of a picture near a file of cameras in `folder` that does not say it. Raises
    BadFileError."""
    from PIL import Image

    for place in (folder, folder / "images", folder.parent, folder.parent / "images"):
        if (place / name).is_file():
            with Image.open(place / name) as picture:
                return picture.size
    raise BadFileError(f"{name[:80]} is not there, and its size is needed")


def _refuse(names: Sequence[str], bad: Any, wanted: str) -> None:
    if bad.any():
        raise BadFileError(f"camera {names[int(np.argmax(bad))][:80]!r} lacks {wanted}")
