"""Pinhole cameras. x right, y down, z forward; pixel centres at +0.5; intrinsics in pixels."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Camera:
    """A pinhole camera.

    width, height: pixels. fx, fy, cx, cy: pixels; the centre of the first pixel is (0.5, 0.5), so
    the centre of the image is (width / 2, height / 2).
    world_to_camera: [4, 4] float64, rigid: x_camera = R x_world + t.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    world_to_camera: NDArray[np.float64]

    @property
    def centre(self) -> NDArray[np.float64]:
        """[3] the camera's position in the world."""
        rotation, translation = self.world_to_camera[:3, :3], self.world_to_camera[:3, 3]
        return -rotation.T @ translation

    @property
    def forward(self) -> NDArray[np.float64]:
        """[3] unit viewing direction in the world."""
        return self.world_to_camera[2, :3].copy()

    def project(
        self, points: NDArray[np.floating]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(pixels [N, 2], z [N]) of points [N, 3] of the world, in float64. Pixels are
        meaningless where z <= 0; at z = 0 they are infinite or NaN."""
        at = points @ self.world_to_camera[:3, :3].T + self.world_to_camera[:3, 3]
        with np.errstate(all="ignore"):
            pixels = at[:, :2] / at[:, 2:] * (self.fx, self.fy) + (self.cx, self.cy)
        return pixels, at[:, 2]

    def shows(self, pixels: NDArray[np.floating]) -> NDArray[np.bool_]:
        """[N] whether pixels [N, 2] lie in the picture, its right and lower edge excluded."""
        return np.asarray(((pixels >= 0) & (pixels < (self.width, self.height))).all(1))

    def resized(self, width: int, height: int) -> Camera:
        """The same view on another pixel grid (both axes scaled separately)."""
        sx, sy = width / self.width, height / self.height
        lens = self.fx * sx, self.fy * sy, self.cx * sx, self.cy * sy
        return Camera(width, height, *lens, self.world_to_camera)

    def continued(self, border: int) -> Camera:
        """The camera whose picture continues this one by `border` pixels on all sides."""
        size = self.width + 2 * border, self.height + 2 * border
        lens = self.fx, self.fy, self.cx + border, self.cy + border
        return Camera(*size, *lens, self.world_to_camera)

    def fitted(self, long_side: int) -> Camera:
        """The same view with its longer side at most `long_side` pixels; never enlarged."""
        return self.resized(*fitted_size(self.width, self.height, long_side))

    def reframed(self, width: int, height: int) -> Camera:
        """The camera with another picture size and aspect ratio. It sees at least what it saw
        before, and more on two sides if the aspect ratio differs."""
        scale = min(width / self.width, height / self.height)
        if abs(scale * self.width - width) < 1.5 and abs(scale * self.height - height) < 1.5:
            return self.resized(width, height)  # the same aspect ratio, to within a pixel
        cx = width / 2 + (self.cx - self.width / 2) * scale
        cy = height / 2 + (self.cy - self.height / 2) * scale
        return Camera(width, height, self.fx * scale, self.fy * scale, cx, cy, self.world_to_camera)

    def moved(self, world_from_new: NDArray[np.float64]) -> Camera:
        """The same camera in a new world frame (x_world = world_from_new x_new), [4, 4]."""
        return replace(self, world_to_camera=self.world_to_camera @ world_from_new)


def fitted_size(width: int, height: int, long_side: int) -> tuple[int, int]:
    """(width, height) scaled down so that the longer side is at most `long_side`; at least 1."""
    if max(width, height) <= long_side:
        return width, height
    scale = long_side / max(width, height)
    return max(1, round(width * scale)), max(1, round(height * scale))


def look_at(
    eye: NDArray[np.float64], target: NDArray[np.float64], up: NDArray[np.float64] | None = None
) -> NDArray[np.float64]:
    """[4, 4] world_to_camera of a camera at `eye` that looks at `target`; up is -Y by default."""
    up_vector = np.array([0.0, -1.0, 0.0]) if up is None else np.asarray(up, dtype=np.float64)
    z = np.asarray(target, np.float64) - np.asarray(eye, np.float64)
    z = z / np.linalg.norm(z)
    x = np.cross(-up_vector, z)
    x = x / np.linalg.norm(x)
    rotation = np.stack([x, np.cross(z, x), z])
    matrix = np.eye(4)
    matrix[:3, :3] = rotation
    matrix[:3, 3] = -rotation @ np.asarray(eye, np.float64)
    return matrix
