"""Cuts equirectangular pictures of the whole sphere into pinhole pictures: the faces of a rig.

Columns of an equirectangular picture are longitudes, rows latitudes. Its middle is +z of the
panorama, x is right and y down, as of a camera. All faces of a panorama have one position and known
turns, so that structure from motion places them as a rig of COLMAP's.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import PurePosixPath

import cv2
import numpy as np
from numpy.typing import NDArray

from stages.ingest.masking import MaskedPhoto
from stages.scene import Face, Photo
from stages.scene.rotations import quaternions_of

# Longitude (to the right) and latitude (up) of each face's middle, degrees: the faces of a
# dodecahedron, nearly. Fields of view of 71.6 degrees are the least that show the whole sphere. Six
# faces of a cube, of 90 degrees, would have three quarters of the pixels a degree at the same size.
DIRECTIONS = (
    *((yaw, 25) for yaw in range(0, 360, 72)),
    *((yaw, -25) for yaw in range(36, 360, 72)),
    *((0, 90), (0, -90)),
)
FIELD_DEG = 72.0  # both ways
# Panoramas are read at this many times the longest side of a face: there the middle of a face has
# as many pixels a degree as the panorama.
WIDTHS = math.pi / math.tan(math.radians(FIELD_DEG / 2))
_MARGIN = 4  # pixels that the picture is continued by on all sides, for interpolation


def face_photos(photo: Photo, masked: MaskedPhoto) -> Iterator[tuple[Photo, MaskedPhoto]]:
    """The faces of a panorama as photographs, with their pictures and masks; `photo` and `masked`
    are of the whole.

    They are square and have as many pixels a degree as the panorama's horizon. Faces that the mask
    covers are left out.
    """
    pixels = masked.decoded.pixels
    height, width = pixels.shape[:2]
    side = max(16, int(width / WIDTHS))
    focal = 0.5 * side / math.tan(math.radians(FIELD_DEG / 2))
    around = _continued(pixels)
    kept = None if masked.mask is None else _continued(masked.mask)
    for yaw, pitch in DIRECTIONS:
        rotation = face_rotation(yaw, pitch)
        tables = _tables(rotation, side, focal, width, height)
        mask = None
        if kept is not None:
            mask = np.asarray(cv2.remap(kept, *tables, cv2.INTER_NEAREST), np.uint8)
            if not mask.any():
                continue
        shown = np.asarray(cv2.remap(around, *tables, cv2.INTER_CUBIC), np.uint8)
        cut = replace(masked.decoded, pixels=shown, unchanged_jpeg=None)
        part = replace(masked, decoded=cut, mask=mask)
        described = face_photo(photo, direction_name(yaw, pitch), side, side, focal)
        w, x, y, z = quaternions_of(rotation).tolist()
        place = Face(photo.camera, photo.name, (w, x, y, z))
        yield replace(described, mask=part.file(described.image), face=place), part


def direction_name(yaw_deg: int, pitch_deg: int) -> str:
    """The name of a face by its direction ("072+25")."""
    return f"{yaw_deg:03d}{pitch_deg:+03d}"


def face_photo(photo: Photo, name: str, width: int, height: int, focal_px: float) -> Photo:
    """The photograph that shows one face of `photo`, without a mask, a depth map and a turn."""
    image = PurePosixPath(photo.image)
    return replace(
        photo,
        name=f"{photo.name}/{name}",
        image=f"{image}/{name}{image.suffix}",
        width=width,
        height=height,
        focal_px=focal_px,
        camera=f"{photo.camera} {name}",
        mask="",
        depth="",
    )


def face_rotation(yaw_deg: float, pitch_deg: float) -> NDArray[np.float64]:
    """[3, 3] from the panorama's axes to the axes of the face in this direction: first the yaw,
    then the pitch, so that the face's x axis stays level."""
    yaw, pitch = np.radians([yaw_deg, pitch_deg])
    x = np.array([np.cos(yaw), 0.0, -np.sin(yaw)])
    z = np.array([np.sin(yaw) * np.cos(pitch), -np.sin(pitch), np.cos(yaw) * np.cos(pitch)])
    return np.stack([x, np.cross(z, x), z])


def _continued(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The picture with a margin: from its other side beyond the seam, and the last row again
    beyond a pole."""
    sides = (0, 0, _MARGIN, _MARGIN)
    wrapped = cv2.copyMakeBorder(picture, *sides, cv2.BORDER_WRAP)
    sides = (_MARGIN, _MARGIN, 0, 0)
    return np.asarray(cv2.copyMakeBorder(wrapped, *sides, cv2.BORDER_REPLICATE), np.uint8)


def _tables(
    rotation: NDArray[np.float64], side: int, focal: float, width: int, height: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """x and y [S, S]: where each pixel of a face lies in the `_continued` picture, for cv2.remap
    (whose pixel centres are whole numbers)."""
    at = (np.arange(side) + 0.5 - side / 2) / focal
    u, v = np.meshgrid(at, at)
    x, y, z = np.einsum("ki,kvu->ivu", rotation, np.stack([u, v, np.ones_like(u)]))
    column = (np.arctan2(x, z) / (2 * np.pi) + 0.5) * width
    row = (np.arctan2(y, np.hypot(x, z)) / np.pi + 0.5) * height
    shift = _MARGIN - 0.5
    return (column + shift).astype(np.float32), (row + shift).astype(np.float32)
