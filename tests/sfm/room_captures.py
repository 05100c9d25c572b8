"""Captures of rooms whose truth is known and in which something is not as it should be.

Drawn by the sample's ray caster without its light: a surface has the colour of its texture.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sample_captures import textures
from sample_captures.make import look_at
from sample_captures.render import Lens, Shape, hit, surface
from stages.scene import Capture
from tests.sfm.checks.bad_captures import capture_of

LENS = Lens(width=320, height=240, focal_px=270.0, k=0.0)
_PAINTS = (textures.WARM, textures.COOL, textures.GARDEN)
_PARTS = 2  # sub-samples of a pixel, each way

Scene = Sequence[Shape]


def picture(scene: Scene, pose: NDArray[np.float64], lens: Lens = LENS) -> NDArray[np.uint8]:
    """[H, W, 3] BGR: what a camera at `pose` (world to camera) sees, with a little noise."""
    eye = (-pose[:3, :3].T @ pose[:3, 3]).astype(np.float32)[:, None]
    total = np.zeros((3, lens.width * lens.height), np.float32)
    for part in range(_PARTS**2):
        dx, dy = (np.array(divmod(part, _PARTS)) + 0.5) / _PARTS
        rays = lens.rays(pose, dx, dy)
        reach = np.stack([hit(shape, eye, rays) for shape in scene])
        points = eye + rays * reach.min(0)
        for number, shape in enumerate(scene):
            mine = reach.argmin(0) == number
            if mine.any():
                total[:, mine] += surface(shape, points[:, mine])[1] / _PARTS**2
    rgb = 255 * total.T.reshape(lens.height, lens.width, 3)
    noise = np.random.default_rng(int(1e6 * abs(eye.sum()))).normal(0, 1.5, rgb.shape)
    return np.clip(rgb[..., ::-1] + noise, 0, 255).astype(np.uint8)


def photographs(
    folder: Path, taken: Sequence[tuple[Scene, NDArray[np.float64]]], lens: Lens = LENS
) -> tuple[Capture, NDArray[np.float64]]:
    """The capture of the `taken` photographs (scene, pose) in order, and its poses [P, 4, 4]."""
    images = {f"{i:03d}.png": picture(*one, lens) for i, one in enumerate(taken)}
    return capture_of(folder, images), np.array([pose for _, pose in taken])


def turned_over(
    folder: Path,
    each: int = 8,
    size: float = 1.0,
    distance: float = 1.9,
    wall_px: int = 600,
    lens: Lens = LENS,
) -> tuple[Capture, NDArray[np.float64]]:
    """Twice around an object in a room full of texture; before the second time the object is
    turned over, and the room stays. size: of the object; wall_px: of the texture of each wall."""
    room = Shape("box", (0.0, 0.0, 0.0), (3.0, 1.4, 3.0), prints(1, wall_px), inside=True)
    upright = [
        Shape("box", at, (size * half[0], size * half[1], size * half[2]), prints(*texture), yaw)
        for at, half, texture, yaw in (
            ((0.0, 0.0, 0.0), (0.5, 0.38, 0.42), (5, 350), 20),
            ((0.62 * size, 0.1 * size, 0.1 * size), (0.2, 0.28, 0.2), (6, 250), -15),
        )
    ]
    over = [
        replace(shape, centre=(x, -y, -z), upside_down=True)
        for shape in upright
        for x, y, z in [shape.centre]
    ]
    first = [([room, *upright], pose) for pose in _around(each, -0.5, 0, distance)]
    second = [([room, *over], pose) for pose in _around(each, -0.45, 3, distance)]
    return photographs(folder, [*first, *second], lens)


def large_turned_over(folder: Path) -> tuple[Capture, NDArray[np.float64]]:
    """`turned_over`, with an object that fills the pictures: 9 % of the pairs contradict the model
    in which it stands still."""
    return turned_over(folder, 13, 1.6, 2.1, 350, Lens(480, 360, 405.0, 0.0))


def weakly_linked(folder: Path, each: int = 7) -> tuple[Capture, NDArray[np.float64]]:
    """Two corners of a bare room, and a small picture between them that two photographs of either
    corner show at their rim."""
    scene = [
        _bare((4.0, 1.4, 3.0)),
        _poster(11, (-2.6, 0.0, 2.5), (1.2, 0.9, 0.05)),
        _poster(12, (2.6, 0.0, 2.5), (1.2, 0.9, 0.05)),
        Shape("box", (-2.3, 0.3, 1.9), (0.25, 0.3, 0.2), prints(21, 250), 20),
        Shape("box", (2.3, 0.3, 1.9), (0.25, 0.3, 0.2), prints(22, 250), -30),
        _poster(13, (0.0, -0.1, 2.6), (0.16, 0.16, 0.05)),
    ]
    taken = []
    for number, x in enumerate([*np.linspace(-3.1, -1.7, each), *np.linspace(1.7, 3.1, each)]):
        between = each - 2 <= number < each + 2
        eye = np.array([x, -0.2 + 0.1 * (number % 2), -0.2 if between else -0.4])
        taken.append(
            (scene, look_at(eye, np.array([(1.35 if between else 2.5) * np.sign(x), 0, 2.4])))
        )
    return photographs(folder, taken)


def same_poster_twice(folder: Path, each: int = 7) -> tuple[Capture, NDArray[np.float64]]:
    """Along a wall of a bare room, round, and along the opposite wall; in the middle of both walls
    hangs the same large poster."""
    scene = [
        _bare((3.2, 1.4, 3.2)),
        _poster(11, (0.0, 0.0, 3.1), (1.0, 0.8, 0.05)),
        _poster(11, (0.0, 0.0, -3.1), (1.0, 0.8, 0.05)),
        _poster(31, (3.1, 0.0, 0.0), (0.05, 0.8, 1.0)),
        *(
            _poster(15 + number, (x, 0.0, z), (0.6, 0.7, 0.05))
            for number, (x, z) in enumerate([(-2.4, 3.1), (2.4, 3.1), (2.4, -3.1), (-2.4, -3.1)])
        ),
    ]
    along = np.linspace(-1.6, 1.6, each)
    taken = [_towards((x, -0.2, 0.3), (0.9 * x, 0.0, 3.1)) for x in along]
    for angle in np.radians(np.linspace(15, 165, each)):
        s, c = np.sin(angle), np.cos(angle)
        taken.append(_towards((1.4 - 1.2 * s, -0.15, -0.6 * c), (1.4 + 2 * s, 0.0, 2.5 * c)))
    taken += [_towards((x, -0.1, -0.3), (0.9 * x, 0.0, -3.1)) for x in along[::-1]]
    return photographs(folder, [(scene, pose) for pose in taken])


def _towards(eye: Sequence[float], target: Sequence[float]) -> NDArray[np.float64]:
    return look_at(np.array(eye, np.float64), np.array(target, np.float64))


def _around(count: int, height: float, seed: int, distance: float) -> list[NDArray[np.float64]]:
    """Poses on most of a circle around the origin, held by hand."""
    random = np.random.default_rng(seed)
    angles = np.radians(np.linspace(-240, 60, count))
    eyes = np.stack([distance * np.cos(angles), height + 0 * angles, distance * np.sin(angles)], 1)
    eyes += random.normal(0, 0.05, eyes.shape)
    return [look_at(eye, random.normal(0, 0.05, 3)) for eye in eyes]


def _bare(half: tuple[float, float, float]) -> Shape:
    """A room whose walls show nothing."""
    grey = np.full((8, 8, 3), 0.6, np.float32)
    return Shape("box", (0.0, 0.0, 0.0), half, (grey,) * 6, inside=True)


def _poster(
    seed: int, centre: tuple[float, float, float], half: tuple[float, float, float]
) -> Shape:
    return Shape("box", centre, half, prints(seed, 400, faces=1) * 6)


def prints(seed: int, size: int, faces: int = 6) -> tuple[NDArray[np.float32], ...]:
    """Textures of a shape's faces, [size, size, 3] each."""
    random = np.random.default_rng(seed)
    return tuple(
        textures.printed(random, size, size, _PAINTS[face % 3], shapes=90) for face in range(faces)
    )
