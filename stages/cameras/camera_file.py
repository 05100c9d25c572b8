"""What every reader of a camera file returns, and the checks that all formats share.

Cameras are in our conventions: world to camera, x right, y down, z forward. The world coordinates
are the file's own; each module says what it changes.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pillow_heif
from numpy.typing import NDArray
from PIL import Image

from stages.base.bad_files import BadFileError
from stages.cameras.lens import Lens
from stages.scene import Camera, View
from stages.scene.place import EarthPlace

MAX_FILE_BYTES = 1 << 30  # cameras and points of thousands of photographs take less
MAX_SIDE_PX = 100_000
MAX_DISTANCE = 1e12  # world units; its square is far from overflowing
ROTATION_TOLERANCE = 1e-3  # of R^T R, for text with three decimals
_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", ".heic")  # of pictures
_NO_NAME = re.compile("[\0\ud800-\udc7f\udd00-\udfff]")  # PEP 383: \udc80 to \udcff are bytes
_EXACT = 1e-12  # of R^T R: a larger error is not rounding of float64


@dataclass(frozen=True)
class Georeference:
    """What a file says of the scale, orientation and place of its world.

    Args:
        metres_per_unit: 0 where it does not say.
        axes: [3, 3] rows that point east, north and up; None where it does not say.
        source: which part of the file says it, in words.
        place: of its world on the earth; None where it does not say.
    """

    metres_per_unit: float = 0.0
    axes: NDArray[np.float64] | None = None
    source: str = ""
    place: EarthPlace | None = None


NO_GEOREFERENCE = Georeference()
Optics = tuple[Sequence[float], Lens]  # (width, height, fx, fy, cx, cy, pixels), the distortion


@dataclass(frozen=True)
class CameraFile:
    """The cameras of a file.

    Args:
        views: V pinhole cameras in the file's order, with their role in the file's own split.
        folder: that `View.image` is relative to.
        lenses: V lenses, the distortion of each view.
        georeference: of the file's world.
        z_up: the world is nerfstudio's or instant-ngp's own, whose z axis points up.
    """

    views: tuple[View, ...]
    folder: Path
    lenses: tuple[Lens, ...]
    georeference: Georeference = NO_GEOREFERENCE
    z_up: bool = False

    @property
    def distorted(self) -> int:
        """How many views have a lens that distorts."""
        return sum(lens.distorts for lens in self.lenses)


@dataclass(frozen=True)
class FilePoints:
    """A camera file's sparse points, in the world of its cameras.

    Args:
        points: [P, 3].
        colours: [P, 3] uint8.
        errors_px: [P] reprojection errors; 0 where the file does not say.
        tracks: [P] views that see each; 0 where the file does not say.
    """

    points: NDArray[np.float64]
    colours: NDArray[np.uint8]
    errors_px: NDArray[np.float64]
    tracks: NDArray[np.int32]


NO_POINTS = FilePoints(
    np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros(0), np.zeros(0, np.int32)
)


def file_points(
    points: NDArray[np.floating],
    colours: NDArray[Any] | None = None,
    tracks: NDArray[np.floating] | None = None,
) -> FilePoints | None:
    """Points [P, 3] of a file that does not say their errors; None if there are none.

    Without colours [P, 3], in 0 to 255, they are grey. Raises BadFileError if a value is not
    finite."""
    if not len(points):
        return None
    none = np.zeros(len(points))
    colours = np.full((len(points), 3), 128.0) if colours is None else colours
    if not (np.isfinite(points).all() and np.isfinite(colours).all()):
        raise BadFileError("a point has a value that is not a number")
    return FilePoints(
        points.astype(np.float64),
        np.clip(colours, 0, 255).astype(np.uint8),
        none,
        (none if tracks is None else tracks).astype(np.int32),
    )


def camera_file(
    folder: Path,
    names: Sequence[str],
    optics: Sequence[Optics],
    poses: NDArray[np.float64],
    georeference: Georeference = NO_GEOREFERENCE,
) -> CameraFile:
    """The checked cameras of a file.

    Args:
        folder, georeference: as in `CameraFile`.
        names: V names.
        optics: V.
        poses: [V, 3, 4] world to camera; rounded rotations are made orthogonal, and translations
            kept.

    Raises:
        BadFileError: there is no camera, or one is invalid.
    """
    if not len(names):
        raise BadFileError("it holds no camera")
    _refuse(names, [bool(_NO_NAME.search(name)) for name in names], "a name that a file can have")
    numbers = np.array([values for values, _ in optics], np.float64).reshape(-1, 6)
    sizes, intrinsics = numbers[:, :2], numbers[:, 2:]
    _refuse(names, ~((sizes >= 1) & (sizes <= MAX_SIDE_PX)).all(1), "a size in pixels")
    bad = ~np.isfinite(intrinsics).all(1) | (intrinsics[:, :2] <= 0).any(1)
    _refuse(names, bad, "a focal length and a principal point")
    _refuse(names, ~(np.abs(poses) < MAX_DISTANCE).all((1, 2)), "a position and a direction")
    rotations = poses[:, :, :3]
    bad = (_orthogonality_error(rotations) > ROTATION_TOLERANCE) | (np.linalg.det(rotations) <= 0)
    _refuse(names, bad, "a rotation matrix")
    matrices = np.tile(np.eye(4), (len(names), 1, 1))
    matrices[:, :3] = poses
    matrices[:, :3, :3] = _without_rounding(rotations)
    views = tuple(
        View(name, name, Camera(int(size[0]), int(size[1]), *lens.tolist(), matrix))  # type: ignore[call-arg]
        for name, size, lens, matrix in zip(names, sizes, intrinsics, matrices, strict=True)
    )
    return CameraFile(views, folder, tuple(lens for _, lens in optics), georeference)


def poses_of(rotations: NDArray[np.float64], centres: NDArray[np.float64]) -> NDArray[np.float64]:
    """[V, 3, 4] world to camera, from its rotations [V, 3, 3] and the cameras' centres [V, 3].

    Rounded rotations are made orthogonal first: otherwise their error times the distance from the
    origin would be an error of the centres.
    """
    with np.errstate(all="ignore"):  # `camera_file` checks the result
        rotations = _without_rounding(rotations)
        translations = -np.einsum("vij,vj->vi", rotations, centres)
    return np.concatenate([rotations, translations[:, :, None]], axis=2)


def _without_rounding(rotations: NDArray[np.float64]) -> NDArray[np.float64]:
    """The rotations [V, 3, 3] nearest to matrices that rounding has changed; other matrices stay
    as they are."""
    error = _orthogonality_error(rotations)
    rounded = (error > _EXACT) & (error <= ROTATION_TOLERANCE)
    left, _, right = np.linalg.svd(rotations[rounded])
    result = rotations.copy()
    result[rounded] = left @ right
    return result


def _orthogonality_error(matrices: NDArray[np.float64]) -> NDArray[np.float64]:
    """[V] the largest error of R^T R."""
    return np.asarray(np.abs(matrices.transpose(0, 2, 1) @ matrices - np.eye(3)).max((1, 2)))


def json_of(path: Path) -> Any:
    """The content of a file of JSON, with or without a byte order mark. Raises as `content_of`, and
    ValueError."""
    return json.loads(content_of(path).decode("utf-8-sig"))


def content_of(path: Path) -> bytes:
    """The content of a file. Raises BadFileError if it is too large for a camera file, because a
    parser would need many times its size in memory."""
    size = path.stat().st_size
    if size > MAX_FILE_BYTES:
        raise BadFileError(f"it has {size / 1e9:.1f} GB; a camera file has 1.1 at most")
    return path.read_bytes()


def check_inside(root: Path, name: str, folder: Path) -> None:
    """Raise BadFileError if the path `name`, seen from `folder`, leaves the folder `root`.

    A camera file from elsewhere must not make the reader open other files of the user. Symbolic
    links are followed: they are the user's own, and data sets often link to their pictures.
    """
    if not Path(os.path.abspath(folder / name)).is_relative_to(os.path.abspath(root)):
        raise BadFileError(
            f"it names {name[:80]}, which is outside {root}",
            hint=f"Put that file into {root}, and change its path in the camera file.",
        )


def size_of_picture(folder: Path, name: str) -> tuple[int, int]:
    """(width, height) of a picture near a camera file in `folder`, for formats that do not say it.
    Raises BadFileError if it is not found or outside the folder above."""
    check_inside(folder.parent, name, folder)
    for near in (folder, folder / "images", folder.parent, folder.parent / "images"):
        if (near / name).is_file():
            return stored_size(near / name)
    raise BadFileError(f"{name[:80]} is not found, and its size is needed")


def picture_beside(path: Path) -> Path | None:
    """The picture of the same name as a camera file; None if there is none."""
    near = (path.with_suffix(suffix) for name in _SUFFIXES for suffix in (name, name.upper()))
    return next((picture for picture in near if picture.is_file()), None)


def stored_size(path: Path) -> tuple[int, int]:
    """(width, height) of a picture. Raises BadFileError if it is none."""
    pillow_heif.register_heif_opener()
    try:
        with Image.open(path) as picture:
            return picture.size
    except Exception as error:  # Pillow's parsers raise whatever the damage leads to
        raise BadFileError(f"its picture {path.name[:80]} cannot be read ({error})") from error


def _refuse(names: Sequence[str], bad: Any, wanted: str) -> None:
    if np.any(bad):
        raise BadFileError(f"camera {names[int(np.argmax(bad))][:80]!r} lacks {wanted}")
