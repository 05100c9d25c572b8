"""How splats look from viewpoints unlike those of the photographs, and how much they shimmer.

Shimmer is temporal aliasing. A camera moves sideways by half a pixel a frame. A picture without
aliasing moves with it, so the middle of three frames is the mean of its neighbours. Detail finer
than a pixel, and splats that change their order, are not. Shimmer is the difference.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from stages.evaluate.evaluation import EvaluationView, ImageRenderer
from stages.evaluate.image_metrics import capped_psnr_db
from stages.scene import Camera
from stages.scene.pictures import scaled_image

STEP_PX = 0.5
FACTOR = 4  # between extreme and usual: distance, or pixels along each side
HIGHER_DEG = 15.0
LARGEST_PX = 2560  # of a picture: a larger one would take minutes, and show the same
Image = NDArray[np.float32]


@dataclass(frozen=True)
class Framing:
    """One way to look at the scene.

    Args:
        label: in words.
        image: [H, W, 3] what is drawn.
        shimmer: root mean square over the picture, in steps of 255.
    """

    label: str
    image: Image
    shimmer: float


def sideways(camera: Camera, pixels: float, depth: float) -> Camera:
    """The camera moved to its right, so that points at `depth` move left by so many pixels."""
    pose = camera.world_to_camera.copy()
    pose[0, 3] -= pixels * depth / camera.fx
    return replace(camera, world_to_camera=pose)


def from_distance(camera: Camera, factor: float, depth: float) -> Camera:
    """The camera moved along its view until points at `depth` are `factor` times as far away."""
    pose = camera.world_to_camera.copy()
    pose[2, 3] += (factor - 1) * depth
    return replace(camera, world_to_camera=pose)


def higher(camera: Camera, degrees: float, depth: float) -> Camera:
    """The camera moved up on a circle around the point at `depth` in the middle of its view."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    turn = np.array([[1, 0, 0, 0], [0, c, -s, s * depth], [0, s, c, depth * (1 - c)], [0, 0, 0, 1]])
    return replace(camera, world_to_camera=turn @ camera.world_to_camera)


def at_resolution(camera: Camera, factor: float) -> Camera:
    """The same view in `factor` times as many pixels along each side, at most `LARGEST_PX`."""
    factor = min(factor, max(1.0, LARGEST_PX / max(camera.width, camera.height)))
    width, height = (max(1, round(factor * side)) for side in (camera.width, camera.height))
    return camera.resized(width, height)


def shimmer(draw: ImageRenderer, camera: Camera, depth: float) -> tuple[Image, float]:
    """The picture and its shimmer in steps of 255. depth: of the subject, world units."""
    before, middle, after = (
        np.clip(draw(sideways(camera, shift * STEP_PX, depth)), 0.0, 1.0) for shift in (-1, 0, 1)
    )
    rest = middle - (before + after) / 2
    return middle.astype(np.float32), float(255 * np.sqrt(np.mean(np.square(rest))))


def framings(draw: ImageRenderer, cameras: Iterable[tuple[Camera, float]]) -> tuple[Framing, ...]:
    """Extreme framings: pictures of the first camera, shimmer as the mean over all cameras.

    Args:
        draw: draws a camera's picture.
        cameras: each with the depth of its subject, world units.
    """
    by_camera = [_framings(draw, camera, depth) for camera, depth in cameras]
    return tuple(
        replace(same[0], shimmer=float(np.mean([framing.shimmer for framing in same])))
        for same in zip(*by_camera, strict=True)
    )


def _framings(draw: ImageRenderer, camera: Camera, depth: float) -> list[Framing]:
    large = at_resolution(camera, FACTOR)
    views = {
        "as photographed": (camera, depth),
        "from a quarter of the distance": (
            from_distance(camera, 1 / FACTOR, depth),
            depth / FACTOR,
        ),
        f"from {FACTOR} times the distance": (from_distance(camera, FACTOR, depth), depth * FACTOR),
        f"from {HIGHER_DEG:g} degrees higher": (higher(camera, HIGHER_DEG, depth), depth),
        "in a quarter of the pixels a side": (at_resolution(camera, 1 / FACTOR), depth),
        f"in {large.width / camera.width:.2g} times the pixels a side": (large, depth),
    }
    return [Framing(label, *shimmer(draw, *view)) for label, view in views.items()]


def small_psnr_db(draw: ImageRenderer, views: Iterable[EvaluationView]) -> tuple[float, float]:
    """Mean PSNR of pictures a quarter as large a side: drawn at that size, and drawn at full size
    and scaled down."""
    found = []
    for view in views:
        small = view.scaled(1 / FACTOR)
        large = np.clip(draw(view.camera), 0.0, 1.0)
        scaled = scaled_image(large, small.camera.width, small.camera.height)
        for drawn in (draw(small.camera), scaled):
            found.append(capped_psnr_db(drawn, small.image, small.valid))
    drawn_small, scaled_down = np.reshape(found, (-1, 2)).mean(axis=0)
    return float(drawn_small), float(scaled_down)
