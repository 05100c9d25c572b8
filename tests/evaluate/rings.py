"""Surfaces and rings of cameras around them, whose gaps are known."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from stages.scene import Camera, Splats, look_at

MIDDLE = np.zeros(3)


def surface(means: np.ndarray, scale: float = 0.08) -> Splats:
    """Solid round splats, one colour."""
    n = len(means)
    return Splats(
        means=means.astype(np.float32),
        quaternions=np.tile(np.array([1, 0, 0, 0], np.float32), (n, 1)),
        log_scales=np.full((n, 3), np.log(scale), np.float32),
        opacity_logits=np.full(n, 6, np.float32),
        sh=np.zeros((n, 1, 3), np.float32),
        sh_degrees=np.zeros(n, np.uint8),
    )


def ball(radius: float = 1.0, count: int = 1500) -> np.ndarray:
    points = np.random.default_rng(4).normal(size=(count, 3))
    return radius * points / np.linalg.norm(points, axis=1, keepdims=True)


def place(heading_deg: float, height_deg: float = 20.0, distance: float = 4.0) -> np.ndarray:
    """Clockwise from +z as seen from above; up is -y."""
    turn, rise = np.radians(heading_deg), np.radians(height_deg)
    level = distance * np.cos(rise)
    return np.array([level * np.sin(turn), -distance * np.sin(rise), level * np.cos(turn)])


def camera(eye: np.ndarray, target: np.ndarray = MIDDLE) -> Camera:
    return Camera(96, 72, 110.0, 110.0, 48.0, 36.0, look_at(eye, target))


def ring(headings: Sequence[float], height: float = 20.0) -> list[Camera]:
    return [camera(place(heading, height)) for heading in headings]
