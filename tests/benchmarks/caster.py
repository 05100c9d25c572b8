"""A compiled ray caster for `tests.sfm.room_captures.picture`.

It draws a thousand pictures of a hall of boxes in minutes instead of an hour.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np
from numpy.typing import NDArray

from sample_captures.render import Lens, Shape
from stages.raster.kernels.simd import kernel

_PARTS = 2  # sub-samples of a pixel, each way


class Boxes:
    """A scene of boxes, made ready to be drawn from many places."""

    def __init__(self, scene: Sequence[Shape]) -> None:
        self._into = np.array([shape.to_local() for shape in scene], np.float64)
        self._middles = np.array([shape.centre for shape in scene], np.float64)
        self._inside = np.array([shape.inside for shape in scene])
        faces = [face for shape in scene for face in shape.faces]
        once = {id(face): face for face in faces}  # all faces of a floor are one
        ends = np.cumsum([0, *(face.size for face in once.values())]).tolist()
        place = dict(zip(once, ends, strict=False))
        self._starts = np.array([place[id(face)] for face in faces]).reshape(-1, 6)
        self._sizes = np.array([face.shape[:2] for face in faces]).reshape(-1, 6, 2)
        self._texels = np.concatenate([face.ravel() for face in once.values()], dtype=np.float32)

    def picture(self, pose: NDArray[np.float64], lens: Lens) -> NDArray[np.float32]:
        """[H, W, 3] RGB in 0..255: what a camera at `pose` (world to camera) sees."""
        out = np.zeros((lens.height, lens.width, 3), np.float32)
        turn = np.ascontiguousarray(pose[:3, :3])
        eyes = np.array(
            [
                m @ (-turn.T @ pose[:3, 3] - c)
                for m, c in zip(self._into, self._middles, strict=True)
            ]
        )
        ways = self._into @ turn.T
        frames = np.array([_frame(way, eye, lens) for way, eye in zip(ways, eyes, strict=True)])
        surfaces = self._inside, self._texels, self._starts, self._sizes
        _cast(lens.focal_px, eyes, ways, frames, *surfaces, out)
        return out * np.float32(255 / _PARTS**2)


def _frame(way: NDArray[np.float64], eye: NDArray[np.float64], lens: Lens) -> NDArray[np.float64]:
    """[4] columns and rows (least, most) between which a box can be seen; see `_cast`."""
    corners = np.linalg.solve(way, (np.array(list(product((-1, 1), repeat=3))) - eye).T)
    if (corners[2] <= 1e-3).any():  # it reaches behind the camera
        return np.array([-np.inf, np.inf, -np.inf, np.inf])
    columns, rows = lens.focal_px * corners[:2] / corners[2]
    columns, rows = columns + lens.width / 2, rows + lens.height / 2
    return np.array([columns.min() - 1, columns.max() + 1, rows.min() - 1, rows.max() + 1])


@kernel
def _cast(focal, eyes, ways, frames, inside, texels, starts, sizes, out):
    """eyes [S, 3], ways [S, 3, 3]: where the camera is, and which way its rays go, in the frame of
    each box, whose half size is 1."""
    height, width = out.shape[:2]
    at = np.empty(3)
    for sample in range(height * width * _PARTS**2):
        pixel, part = sample // _PARTS**2, sample % _PARTS**2
        row, column = pixel // width, pixel % width
        x = (column + (part // _PARTS + 0.5) / _PARTS - width / 2) / focal
        y = (row + (part % _PARTS + 0.5) / _PARTS - height / 2) / focal
        nearest, reach = 0, np.inf
        for shape in range(len(eyes)):
            if not frames[shape, 0] <= column <= frames[shape, 1]:
                continue
            if not frames[shape, 2] <= row <= frames[shape, 3]:
                continue
            near, far = -np.inf, np.inf
            for k in range(3):
                way = ways[shape, k, 0] * x + ways[shape, k, 1] * y + ways[shape, k, 2]
                once = 1.0 / way if abs(way) > 1e-12 else 1e12
                middle, half = -eyes[shape, k] * once, abs(once)
                near, far = max(near, middle - half), min(far, middle + half)
            found = far if inside[shape] else near
            if near < far and 1e-4 < found < reach:
                nearest, reach = shape, found
        for k in range(3):
            way = ways[nearest, k, 0] * x + ways[nearest, k, 1] * y + ways[nearest, k, 2]
            at[k] = eyes[nearest, k] + reach * way
        _add_colour(at, nearest, inside, texels, starts, sizes, row, column, out)


@kernel
def _add_colour(at, box, inside, texels, starts, sizes, y, x, out):
    """Add the colour of the box's surface where the ray meets it; textures lie as in
    `sample_captures.render.surface`."""
    axis = 0
    for k in range(1, 3):
        if abs(at[k]) > abs(at[axis]):
            axis = k
    above = at[axis] > 0
    side = 1.0 if above != inside[box] else -1.0
    u = at[0] if axis == 1 else (side if axis == 0 else -side) * (at[2] if axis == 0 else at[0])
    v = side * at[2] if axis == 1 else at[1]
    face = 2 * axis + int(above)
    high, wide, start = sizes[box, face, 0], sizes[box, face, 1], starts[box, face]
    row = min(max((v + 1) / 2 * high - 0.5, 0.0), high - 1.0)
    column = min(max((u + 1) / 2 * wide - 0.5, 0.0), wide - 1.0)
    r0, c0 = int(row), int(column)
    r1, c1 = min(r0 + 1, high - 1), min(c0 + 1, wide - 1)
    fr, fc = row - r0, column - c0
    for k in range(3):
        top = (1 - fc) * texels[start + 3 * (r0 * wide + c0) + k]
        top += fc * texels[start + 3 * (r0 * wide + c1) + k]
        low = (1 - fc) * texels[start + 3 * (r1 * wide + c0) + k]
        low += fc * texels[start + 3 * (r1 * wide + c1) + k]
        out[y, x, k] += np.float32((1 - fr) * top + fr * low)
