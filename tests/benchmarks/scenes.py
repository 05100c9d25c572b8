"""Scenes to time: random ones of any size, the one that other projects are compared on, and
trained ones from files."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from stages.scene import Camera, Splats, logit, rgb_to_dc

PICTURES = ((480, 270), (960, 540), (1920, 1080))  # width, height


def view(width: int, height: int) -> Camera:
    """A camera at the origin with a field of view of 53 degrees across, as a phone has."""
    return Camera(width, height, width, width, width / 2, height / 2, np.eye(4))


def random_scene(n: int, camera: Camera, degree: int = 1, seed: int = 0) -> Splats:
    """n splats that cover the picture about as densely whatever n is; drawn in this order: depth,
    place on the picture, sizes, turns, opacities, colours."""
    r = np.random.default_rng(seed)
    width, height, focal = camera.width, camera.height, camera.fx
    z = r.uniform(2, 6, n)
    u, v = r.uniform(0, width, n), r.uniform(0, height, n)
    means = np.stack([(u - width / 2) * z / focal, (v - height / 2) * z / focal, z], 1)
    size = 0.8 * np.sqrt(width * height / n) * z / focal
    log_scales = np.log(size)[:, None] + r.normal(0, 0.4, (n, 3))
    quaternions = r.normal(size=(n, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    opacities = r.uniform(0.05, 0.95, n)
    sh = np.zeros((n, (degree + 1) ** 2, 3), np.float32)
    sh[:, 0] = rgb_to_dc(r.uniform(0, 1, (n, 3)))
    if degree:
        sh[:, 1:] = r.normal(0, 0.05, sh[:, 1:].shape)
    return Splats(
        means.astype(np.float32),
        quaternions.astype(np.float32),
        log_scales.astype(np.float32),
        logit(opacities).astype(np.float32),
        sh,
        np.full(n, degree, np.uint8),
    )


def equal_scene(n: int, side: int) -> tuple[Splats, Camera, np.ndarray]:
    """The scene on which CPU rasterisers have been compared (degree 0, square picture), and the
    gradient [3, side, side] that comes in."""
    camera = Camera(side, side, side, side, side / 2, side / 2, np.eye(4))
    r = np.random.default_rng(0)
    z, u, v = r.uniform(2, 6, n), r.uniform(0, side, n), r.uniform(0, side, n)
    means = np.stack([(u - side / 2) * z / side, (v - side / 2) * z / side, z], 1)
    scales = (0.8 * np.sqrt(side * side / n) * z / side)[:, None] * np.exp(r.normal(0, 0.4, (n, 3)))
    quaternions = r.normal(size=(n, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    opacities, rgb = r.uniform(0.05, 0.95, n), r.uniform(0, 1, (n, 3))
    v_image = r.normal(size=(side, side, 3)).astype(np.float32).transpose(2, 0, 1)
    splats = Splats(
        means.astype(np.float32),
        quaternions.astype(np.float32),
        np.log(scales).astype(np.float32),
        logit(opacities).astype(np.float32),
        rgb_to_dc(rgb)[:, None].astype(np.float32),
        np.zeros(n, np.uint8),
    )
    return splats, camera, np.ascontiguousarray(v_image)


def trained_scene(run: Path, long_side: int) -> tuple[Splats, Camera]:
    """The trained splats of a run folder, seen from its first photograph at `long_side` pixels."""
    from stages.scene import load_splats
    from stages.sfm.stage import load

    splats = load_splats(run / "4-train")
    camera = load(run / "2-sfm").views[0].camera.fitted(long_side)
    return splats, splats.local(camera)
