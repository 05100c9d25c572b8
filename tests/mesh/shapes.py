"""Shapes made of splats whose surface is known, seen by cameras around them."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.scene import Camera, Reconstruction, Splats, View, look_at, rgb_to_dc

CENTRE = np.array([0.5, -1.0, 0.2])  # of the sphere; radius 1


def directions(count: int) -> NDArray[np.float64]:
    """[count, 3] unit, evenly over the sphere (Fibonacci lattice)."""
    i = np.arange(count) + 0.5
    y, turn = 1 - 2 * i / count, np.pi * (1 + 5**0.5) * i
    r = np.sqrt(1 - y * y)
    return np.stack([r * np.cos(turn), y, r * np.sin(turn)], axis=1)


def ball(
    centre: NDArray[np.floating],
    radius: float,
    rgb: tuple[float, float, float],
    count: int = 4000,
    logit: float = 4.0,
) -> Splats:
    """A sphere tiled with discs of splats, each flat against it."""
    outwards = directions(count)
    across = 2.2 * radius / np.sqrt(count)  # two thirds of the way from one to the next
    flat = across / 20
    dc = rgb_to_dc(np.broadcast_to(np.array(rgb, np.float32), (count, 3)))
    # The half-way rotation from z to the normal: (1 + n_z, z x n), which is never zero here.
    quaternions = np.stack(
        [1 + outwards[:, 2], -outwards[:, 1], outwards[:, 0], np.zeros(count)], axis=1
    )
    return Splats(
        means=(centre + radius * outwards).astype(np.float32),
        quaternions=quaternions.astype(np.float32),
        log_scales=np.tile(np.log([across, across, flat]), (count, 1)).astype(np.float32),
        opacity_logits=np.full(count, logit, np.float32),
        sh=np.asarray(dc, np.float32)[:, None],
        sh_degrees=np.zeros(count, np.uint8),
    )


def sphere(rgb: tuple[float, float, float] = (1.0, 0.5, 0.0), logit: float = 4.0) -> Splats:
    return ball(CENTRE, 1.0, rgb, logit=logit)


def joined(*parts: Splats) -> Splats:
    names = ("means", "quaternions", "log_scales", "opacity_logits", "sh", "sh_degrees")
    arrays: dict[str, Any] = {
        name: np.concatenate([getattr(part, name) for part in parts]) for name in names
    }
    return Splats(**arrays)


def seen_from(
    eyes: Iterable[NDArray[np.floating]],
    target: NDArray[np.float64] = CENTRE,
    points: NDArray[np.float64] | None = None,
) -> Reconstruction:
    """Cameras of 160 x 120 pixels at `eyes`. Every eighth would be held out: each of those stands
    beside its neighbour, so that nothing is missed."""
    views: list[View] = []
    for eye in eyes:
        if len(views) % 8 == 0:
            views.append(_view(len(views), eye, target))
        views.append(_view(len(views), eye, target))
    points = np.zeros((0, 3)) if points is None else points
    n = len(points)
    return Reconstruction(
        folder=Path(),
        views=tuple(views),
        points=points,
        colours=np.zeros((n, 3), np.uint8),
        errors_px=np.zeros(n),
        tracks=np.full(n, 2, np.int32),
    )


def _view(number: int, eye: NDArray[np.floating], target: NDArray[np.float64]) -> View:
    name = f"{number:03}.png"
    return View(
        name,
        name,
        Camera(160, 120, 150.0, 150.0, 80.0, 60.0, look_at(eye.astype(np.float64), target)),
    )


def all_around(count: int = 14) -> Reconstruction:
    """The sphere from all sides, with points on it."""
    return seen_from(CENTRE + 3.5 * directions(count), points=CENTRE + directions(500))
