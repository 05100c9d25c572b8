"""Photographs of a wall and of a square plate before it, whose depths are known."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from stages.scene import Camera, View, look_at

WIDTH, HEIGHT, FOCAL = 160, 120, 150.0
WALL, PLATE, HALF = 6.0, 4.0, 0.7  # depths of a wall and of a square plate before it
EYES = [(x, y, 0.0) for x in (-0.9, -0.3, 0.3, 0.9) for y in (-0.3, 0.3)]


def texture(seed: int) -> np.ndarray:
    noise = np.random.default_rng(seed).uniform(30, 225, (96, 96, 3)).astype(np.float32)
    return cv2.resize(noise, (768, 768), interpolation=cv2.INTER_CUBIC).clip(0, 255)


def capture(folder: Path, plain: bool = False) -> tuple[tuple[View, ...], np.ndarray]:
    """(photographs of the wall and the plate, a few points measured on them)."""
    paints = [np.full((768, 768, 3), 90, np.float32) if plain else texture(s) for s in (1, 2)]
    made = []
    for number, eye in enumerate(np.array(EYES)):
        camera = Camera(
            WIDTH, HEIGHT, FOCAL, FOCAL, 80.0, 60.0, look_at(eye, np.array([0.0, 0.0, 5.0]))
        )
        rows, columns = np.mgrid[:HEIGHT, :WIDTH] + 0.5
        rays = np.stack([(columns - 80) / FOCAL, (rows - 60) / FOCAL, np.ones_like(rows)], -1)
        rays = rays @ camera.world_to_camera[:3, :3]
        image = np.zeros((HEIGHT, WIDTH, 3), np.float32)
        for depth, paint in zip((WALL, PLATE), paints, strict=True):
            at = eye + rays * ((depth - eye[2]) / rays[..., 2:])
            where = ((at[..., :2] + 5) / 10 * 768).astype(np.float32)
            colours = cv2.remap(paint, where[..., 0], where[..., 1], cv2.INTER_LINEAR)
            shown = np.abs(at[..., :2]).max(-1) < (HALF if depth == PLATE else np.inf)
            image[shown] = colours[shown]
        name = f"{number}.png"
        Image.fromarray(np.uint8(image)).save(folder / name)
        made.append(View(name, name, camera))
    random = np.random.default_rng(5)
    near, far = random.uniform(-HALF, HALF, (40, 2)), random.uniform(-2.0, 2.0, (80, 2))
    far = far[np.abs(far).max(1) > 1.2 * HALF]
    points = np.concatenate([np.c_[near, np.full(40, PLATE)], np.c_[far, np.full(len(far), WALL)]])
    return tuple(made), points
