"""Scenes to measure on: like trained ones, of any size, and hostile ones."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from stages.scene import Camera, Splats
from tests.scenes import camera, cloud, join, splats

ODD = ((1, 1), (3, 257), (47, 33), (17, 9), (130, 71), (255, 16), (641, 37), (97, 241))
TOY_ODD = ((1, 1), (17, 9))


def trained_like(n: int, view: Camera, degree: int = 3, seed: int = 0) -> Splats:
    """n splats as training leaves them: half of them out of view, most of about a pixel, a long
    tail of large ones, opacities at both ends."""
    r = np.random.default_rng(seed)
    width, height, focal = view.width, view.height, view.fx
    z = r.uniform(1.5, 15, n).astype(np.float32)
    # 1.41 pictures across and down: half of the area lies outside
    u = (r.random(n, np.float32) * 1.41 - 0.205) * width
    v = (r.random(n, np.float32) * 1.41 - 0.205) * height
    pixel = z / focal
    means = np.stack([(u - width / 2) * pixel, (v - height / 2) * pixel, z], 1)
    largest = np.sqrt(width * height / n) * np.exp(r.normal(-0.2, 0.8, n))
    thinner = np.exp(-np.abs(r.normal(0, 1.0, (n, 3))))
    log_scales = np.log((largest * pixel)[:, None] * thinner)
    coefficients = (degree + 1) ** 2
    sh = r.standard_normal((n, coefficients, 3), np.float32) * np.float32(0.05)
    sh[:, 0] = r.standard_normal((n, 3), np.float32)
    logits = r.normal(np.where(r.random(n) < 0.4, 2.0, -2.5), 1.5)
    return Splats(
        means.astype(np.float32),
        r.standard_normal((n, 4), np.float32),
        log_scales.astype(np.float32),
        logits.astype(np.float32),
        sh,
        np.full(n, degree, np.uint8),
    )


def odd_scenes(first: int, toy: bool) -> Iterator[tuple[str, Splats, Camera]]:
    """(name, scene, view) without end: random scenes at odd sizes, and each kind of hostile one."""
    number = first
    sizes, n = (TOY_ODD, 12) if toy else (ODD, 300)
    while True:
        width, height = sizes[number % len(sizes)]
        view = camera(width, height)
        size_px = (0.3, 3.0, 30.0)[number % 3]
        scene = cloud(n, width, height, number % 4, number, size_px, 0.5 + number % 2)
        kinds = list(hostile(scene, width, height, number))
        name, made = kinds[number // len(sizes) % len(kinds)]
        yield f"{number}: {name} at {width}x{height}, degree {number % 4}", made, view
        number += 1


def hostile(scene: Splats, width: int, height: int, seed: int) -> Iterator[tuple[str, Splats]]:
    """(what it is, the scene with it)."""
    yield "random", scene
    r, some = np.random.default_rng(seed), slice(0, len(scene) // 3)
    yield "damaged rows", _damaged(scene)
    needles = _copy(scene)
    needles.log_scales[some] = np.log([3.0, 1e-4, 1e-4]).astype(np.float32)
    yield "needles", needles
    flat = _copy(scene)
    flat.means[:, 2] = 3.0
    flat.means[some, :2] = flat.means[0, :2]
    yield "equal depths", flat
    solid = _copy(scene)
    solid.opacity_logits[:] = r.choice([-30.0, -5.54, 0.0, 4.6, 30.0, 88.0], len(scene))
    yield "extreme opacities", solid
    turned = _copy(scene)
    turned.quaternions[:] *= np.exp(r.uniform(-60, 60, (len(scene), 1))).astype(np.float32)
    yield "quaternions of any norm", turned
    near = _copy(scene)
    near.means[some, 2] = r.uniform(-1, 0.3, len(near.means[some]))
    yield "around the near plane", near
    huge = splats([[0, 0, 2.0], [0.5, 0.1, 1.0]], scales=[[50.0], [4.0]], opacities=0.4)
    yield "larger than the picture", join(scene, huge)
    yield "none visible", scene.take(np.zeros(0, np.intp))


def _damaged(scene: Splats) -> Splats:
    """With a value that is not finite, or too large, in every kind of parameter."""
    made = _copy(scene)
    made.means[0, 1], made.quaternions[1] = np.nan, 0.0
    made.log_scales[2, 0], made.opacity_logits[3] = np.inf, np.nan
    made.sh[4, 0, 0], made.log_scales[5] = -np.inf, 80.0
    made.means[6], made.log_scales[7] = 1e30, -100.0
    return made


def _copy(scene: Splats) -> Splats:
    return scene.take(np.arange(len(scene)))
