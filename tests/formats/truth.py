"""One splat whose every stored value is known by hand, and formulas written out a second time."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from stages.scene import Splats

# 60 degrees about the axis (1, 2, 2) / 3: no two components are equal up to sign except y and z,
# so a wrong order of w, x, y, z shows.
QUATERNION = np.array([math.sqrt(0.75), 1 / 6, 2 / 6, 2 / 6])
SCALES = np.array([0.1, 0.2, 0.4])
OPACITY = 0.75
MEAN = np.array([1.0, 2.0, 3.0])
RED = np.array([0.9, 0.1, 0.2])
C0, C1 = 0.28209479177387814, 0.4886025119029199


def red_splat(scale_quaternion: float = 3.0) -> Splats:
    """A red splat at (1, 2, 3), greener seen along +y, of degree 1; its quaternion is not unit."""
    sh = np.zeros((1, 4, 3))
    sh[0, 0] = (RED - 0.5) / C0
    sh[0, 1] = (0.0, -0.3, 0.0)  # m = -1: -C1 y
    sh[0, 2] = (0.1, 0.0, 0.0)  # m = 0: +C1 z
    sh[0, 3] = (0.0, 0.0, 0.2)  # m = 1: -C1 x
    return Splats(
        means=MEAN[None].astype(np.float32),
        quaternions=(scale_quaternion * QUATERNION)[None].astype(np.float32),
        log_scales=np.log(SCALES)[None].astype(np.float32),
        opacity_logits=np.array([math.log(3.0)], np.float32),
        sh=sh.astype(np.float32),
        sh_degrees=np.array([1], np.uint8),
    )


def colour(sh: NDArray[np.floating], direction: NDArray[np.floating]) -> NDArray[np.floating]:
    """[3] of one splat's `sh` [K, 3] seen along `direction`: the basis as printed in appendix A
    of KHR_gaussian_splatting."""
    x, y, z = direction / np.linalg.norm(direction)
    basis = [
        C0,
        *(-C1 * y, C1 * z, -C1 * x),
        1.092548430592079 * x * y,
        -1.092548430592079 * y * z,
        0.31539156525252 * (2 * z * z - x * x - y * y),
        -1.092548430592079 * x * z,
        0.5462742152960395 * (x * x - y * y),
        -0.5900435899266435 * y * (3 * x * x - y * y),
        2.890611442640554 * x * y * z,
        -0.4570457994644657 * y * (4 * z * z - x * x - y * y),
        0.3731763325901154 * z * (2 * z * z - 3 * x * x - 3 * y * y),
        -0.4570457994644657 * x * (4 * z * z - x * x - y * y),
        1.445305721320277 * z * (x * x - y * y),
        -0.5900435899266435 * x * (x * x - 3 * y * y),
    ]
    return 0.5 + np.array(basis[: len(sh)]) @ sh


def covariance(
    quaternion: NDArray[np.floating], scales: NDArray[np.floating]
) -> NDArray[np.float64]:
    """[3, 3] from w, x, y, z and standard deviations, by turning each axis with q v q*."""
    w, u = float(quaternion[0]), np.asarray(quaternion[1:], np.float64)
    axes = [2 * u * (u @ e) + (w * w - u @ u) * e + 2 * w * np.cross(u, e) for e in np.eye(3)]
    rotation = np.stack(axes, axis=1) / (w * w + u @ u)
    return rotation @ np.diag(np.asarray(scales, np.float64) ** 2) @ rotation.T


def many_splats(n: int = 300, seed: int = 1) -> Splats:
    """Splats of all four degrees, with an origin far away."""
    rng = np.random.default_rng(seed)
    degrees = (np.arange(n) % 4).astype(np.uint8)
    sh = rng.normal(0, 0.3, (n, 16, 3)).astype(np.float32)
    for degree in range(4):
        sh[degrees == degree, (degree + 1) ** 2 :] = 0
    return Splats(
        means=rng.normal(0, 2, (n, 3)).astype(np.float32),
        quaternions=rng.normal(0, 3, (n, 4)).astype(np.float32),
        log_scales=rng.normal(-3, 1, (n, 3)).astype(np.float32),
        opacity_logits=rng.normal(0, 3, n).astype(np.float32),
        sh=sh,
        sh_degrees=degrees,
        origin=np.array([4e6 + 1 / 3, -2.0, 0.1]),
    )


def extreme_splats(degree: int) -> Splats:
    """Four that can be drawn, with values at the ends of what a float32 or a viewer can hold."""
    splats = many_splats(4).with_sh_degree(degree)
    splats.log_scales[:] = np.array([[40, -8, -8], [-200, 0, 0], [9, -0.3, -0.3], [-9, -9, -9]])
    splats.opacity_logits[:] = [100, -100, 20, -20]
    splats.quaternions[:2] = np.array([[1e-19, 0, 0, 1e-19], [1e20, 0, 1e20, 0]])
    splats.means[3] = (7e8, -3e38, 1e-40)
    return splats
