"""How splats look from where no photograph was taken: framings, and how much they shimmer.

A camera glides sideways, half a pixel a frame. What is drawn well glides with it, and the middle of
three frames is the mean of its neighbours; what is finer than the pixels, or jumps from one splat
to the next, is not. The rest is the shimmer.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from stages.measure.evaluation import EvaluationView, capped_psnr_db
from stages.scene import Camera

STEP_PX = 0.5
FEWER = 4  # times as many pixels a side, or as far away; or a quarter of it
HIGHER_DEG = 15.0
LARGEST_PX = 2560  # of a picture: a larger one would take minutes, and say the same
Draw = Callable[[Camera], NDArray[np.floating]]
Image = NDArray[np.float32]


@dataclass(frozen=True)
class Framing:
    """A way to look at the scene. label: in words. image [H, W, 3]: what is drawn. shimmer: root
    mean square over the picture, in steps of 255."""

    label: str
    image: Image
    shimmer: float


def sideways(camera: Camera, pixels: float, depth: float) -> Camera:
    """The camera moved to its right, so that what is at `depth` moves left by so many pixels."""
    pose = camera.world_to_camera.copy()
    pose[0, 3] -= pixels * depth / camera.fx
    return replace(camera, world_to_camera=pose)


def from_distance(camera: Camera, factor: float, depth: float) -> Camera:
    """The camera moved along its view until what is at `depth` is `factor` times as far away."""
    pose = camera.world_to_camera.copy()
    pose[2, 3] += (factor - 1) * depth
    return replace(camera, world_to_camera=pose)


def higher(camera: Camera, degrees: float, depth: float) -> Camera:
    """The camera moved up on a circle around what is at `depth` in the middle of its view."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    turn = np.array([[1, 0, 0, 0], [0, c, -s, s * depth], [0, s, c, depth * (1 - c)], [0, 0, 0, 1]])
    return replace(camera, world_to_camera=turn @ camera.world_to_camera)


def at_resolution(camera: Camera, factor: float) -> Camera:
    """The same view in `factor` times as many pixels along each side, at most `LARGEST_PX`."""
    factor = min(factor, max(1.0, LARGEST_PX / max(camera.width, camera.height)))
    width, height = (max(1, round(factor * side)) for side in (camera.width, camera.height))
    return camera.resized(width, height)


def shimmer(draw: Draw, camera: Camera, depth: float) -> tuple[Image, float]:
    """(the picture, its shimmer in steps of 255). depth: of what matters, world units."""
    before, middle, after = (
        np.clip(draw(sideways(camera, shift * STEP_PX, depth)), 0.0, 1.0) for shift in (-1, 0, 1)
    )
    rest = middle - (before + after) / 2
    return middle.astype(np.float32), float(255 * np.sqrt(np.mean(np.square(rest))))


def framings(draw: Draw, cameras: Iterable[tuple[Camera, float]]) -> tuple[Framing, ...]:
    """The extremes: pictures of the first camera, shimmer as the mean over all. cameras: each with
    the depth of what matters, world units."""
    seen = [_framings(draw, camera, depth) for camera, depth in cameras]
    return tuple(
        replace(alike[0], shimmer=float(np.mean([framing.shimmer for framing in alike])))
        for alike in zip(*seen, strict=True)
    )


def _framings(draw: Draw, camera: Camera, depth: float) -> list[Framing]:
    large = at_resolution(camera, FEWER)
    views = {
        "as photographed": (camera, depth),
        "from a quarter of the distance": (from_distance(camera, 1 / FEWER, depth), depth / FEWER),
        f"from {FEWER} times the distance": (from_distance(camera, FEWER, depth), depth * FEWER),
        f"from {HIGHER_DEG:g} degrees higher": (higher(camera, HIGHER_DEG, depth), depth),
        "in a quarter of the pixels a side": (at_resolution(camera, 1 / FEWER), depth),
        f"in {large.width / camera.width:.2g} times the pixels a side": (large, depth),
    }
    return [Framing(label, *shimmer(draw, *view)) for label, view in views.items()]


def small_psnr_db(draw: Draw, photographs: Iterable[EvaluationView]) -> tuple[float, float]:
    """Mean PSNR of pictures a quarter as large a side: (drawn so, drawn whole and scaled down)."""
    found = []
    for photograph in photographs:
        camera, kept = photograph.camera, photograph.kept
        truth = blocks(photograph.image)
        counts = None if kept is None else blocks(kept[..., None]) == 1
        fx, fy, cx, cy = (x / FEWER for x in (camera.fx, camera.fy, camera.cx, camera.cy))
        small = Camera(truth.shape[1], truth.shape[0], fx, fy, cx, cy, camera.world_to_camera)
        for drawn in (draw(small), blocks(np.clip(draw(camera), 0.0, 1.0))):
            found.append(capped_psnr_db(drawn, truth, None if counts is None else counts[..., 0]))
    drawn_small, scaled_down = np.reshape(found, (-1, 2)).mean(axis=0)
    return float(drawn_small), float(scaled_down)


def blocks(image: NDArray[np.generic]) -> Image:
    """Means over blocks of 4 x 4 pixels of [H, W, C]; what is left over at the rim goes."""
    height, width = (side // FEWER for side in image.shape[:2])
    whole = image[: height * FEWER, : width * FEWER].astype(np.float32)
    means: Image = whole.reshape(height, FEWER, width, FEWER, -1).mean(axis=(1, 3))
    return means
