"""A scene that no turn or reflection leaves as it is, where it is seen from, and wrong pictures."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from PIL import Image

from stages.raster.draw import render
from stages.scene import Camera, Splats, View, look_at
from tests import scenes

SIZE = (320, 240)
WORSE_DB = 8.0
"""By how much at least a wrong picture is worse than the right one."""


def coloured_scene() -> Splats:
    """A different colour towards each side, needles that lean one way, and some that change
    colour with the view: no turn or reflection leaves it as it is."""
    blobs = [
        ((-1.0, 0.0, 0.0), (1.0, 0.1, 0.1)),
        ((1.0, 0.2, 0.0), (0.1, 0.9, 0.1)),
        ((0.1, -0.8, 0.3), (0.1, 0.2, 1.0)),
        ((-0.3, 0.8, -0.2), (1.0, 0.9, 0.1)),
        ((0.2, 0.1, 1.0), (0.9, 0.9, 0.9)),
        ((0.3, 0.3, -0.9), (0.8, 0.1, 0.8)),
    ]
    means = [mean for mean, _ in blobs]
    parts = [
        scenes.splats(means, 0.22, 0.9, [rgb for _, rgb in blobs]),
        scenes.splats(
            [(0.55, -0.5, 0.0), (-0.6, -0.45, 0.2)],
            (0.5, 0.04, 0.1),
            0.95,
            (0.1, 0.8, 0.9),
            (0.93, 0.1, 0.05, 0.35),
        ),
    ]
    shiny = scenes.splats([(-0.7, 0.5, 0.5), (0.7, 0.7, -0.3)], 0.2, 0.9).with_sh_degree(3)
    shiny.sh[:, 1:] = np.random.default_rng(3).normal(0, 0.3, shiny.sh[:, 1:].shape)
    shiny = replace(shiny, sh_degrees=np.full(2, 3, np.uint8))
    parts.append(shiny)
    joined = scenes.join(*parts)
    return replace(joined, sh_degrees=np.full(len(joined), 3, np.uint8))


def views() -> tuple[View, ...]:
    """Seen from all around, each camera rolled and with its principal point off centre."""
    made = []
    for i, angle in enumerate(np.radians([20, 140, 260, 300])):
        eye = np.array([3.2 * np.cos(angle), -1.2 + 0.6 * i, 3.2 * np.sin(angle)])
        matrix = look_at(eye, np.array([0.1, 0.0, 0.0]), np.array([0.25, -1.0, 0.1]))
        camera = Camera(*SIZE, 300.0, 300.0, 150.0 + 8 * i, 128.0, matrix)
        made.append(View(f"day 1/<{i}>.png", f"{i}.png", camera))
    return tuple(made)


def drawn(view: View) -> np.ndarray:
    """What `splat render` writes for a view: colours brighter than white are white."""
    return np.clip(render(coloured_scene(), view.camera).image, 0, 1)


def turned(picture: np.ndarray, degrees: float) -> np.ndarray:
    image = Image.fromarray(np.uint8(picture * 255)).rotate(degrees, Image.Resampling.BILINEAR)
    return np.asarray(image, np.float32) / 255


def wrong_versions(picture: np.ndarray) -> dict[str, np.ndarray]:
    return {
        "mirrored": picture[:, ::-1],
        "upside down": picture[::-1],
        "turned by 180 degrees": picture[::-1, ::-1],
        "tilted by 10 degrees": turned(picture, 10),
        "tilted by -10 degrees": turned(picture, -10),
        "red and blue swapped": picture[..., ::-1],
        "beside its place": np.roll(picture, 8, axis=1),
        "too bright": picture ** (1 / 2.2),
    }
