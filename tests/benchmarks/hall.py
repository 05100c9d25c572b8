"""Pictures of long walks whose truth is known: around pillars in a hall, or through a finished run.

The walk in the hall goes once around each of several pillars, one
for every 25 photographs, and at the end comes back to the first. A run's splats are drawn along a
way through its own photographs' places, which is where they can be believed.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from sample_captures.make import look_at
from sample_captures.render import Lens, Shape
from tests.benchmarks.caster import Boxes
from tests.sfm.room_captures import prints

AROUND = 25  # photographs of a pillar
APART, REACH = 3.0, 1.6  # metres between pillars, and from a pillar to the camera
SHAKE, SWAY = 0.04, 0.06  # metres: of the hand, and of what it aims at
BLUR_PX = 0.6
NOISE = 2.0  # of 255
SEEN = 3  # pillars: the nearest
QUALITY = 90

Pictures = Callable[[int], NDArray[np.uint8]]


@dataclass(frozen=True)
class Walk:
    """poses [P, 4, 4] world_to_camera. picture(number): [H, W, 3] BGR, blurred and noisy."""

    poses: NDArray[np.float64]
    picture: Pictures

    def take(self, folder: Path) -> None:
        """Save the photographs that are not there yet."""
        folder.mkdir(parents=True, exist_ok=True)
        for number in range(len(self.poses)):
            path = folder / f"{number:04d}.jpg"
            if not path.exists():
                how = [cv2.IMWRITE_JPEG_QUALITY, QUALITY]
                cv2.imencode(".jpg", self.picture(number), how)[1].tofile(path)


def in_hall(photographs: int, width: int) -> Walk:
    """Photographs of `width` x 3/4 `width` pixels."""
    pillars = _places(photographs)
    poses = _around(photographs, pillars)
    lens = Lens(width=width, height=width * 3 // 4, focal_px=0.675 * width, k=0.0)
    backdrop = Shape("box", (0.0, 0.0, 0.0), (200.0, 3.0, 200.0), prints(1, 64), inside=True)

    standing = functools.lru_cache(8)(lambda number: _pillar(number, *pillars[number]))

    @functools.lru_cache(2)
    def around(near: tuple[int, ...]) -> Boxes:
        return Boxes([backdrop, *(shape for n in near for shape in standing(n))])

    def draw(number: int) -> NDArray[np.uint8]:
        eye = -poses[number][:3, :3].T @ poses[number][:3, 3]
        near = np.argsort(np.linalg.norm(pillars - eye[[0, 2]], axis=1))[:SEEN]
        drawn = around(tuple(sorted(near.tolist()))).picture(poses[number], lens)[..., ::-1]
        return _as_taken(drawn, number)

    return Walk(poses, draw)


def _places(photographs: int) -> NDArray[np.float64]:
    """[M, 2] x and z of the pillars: on a ring."""
    count = max(2, round(photographs / AROUND))
    radius = APART / (2 * np.sin(np.pi / count))
    angles = 2 * np.pi * np.arange(count) / count
    return radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)


def _around(photographs: int, pillars: NDArray[np.float64]) -> NDArray[np.float64]:
    """[P, 4, 4] world_to_camera, held by hand: around each pillar in turn."""
    random = np.random.default_rng(3)
    poses = []
    for number in range(photographs):
        pillar, share = divmod(number * len(pillars) / photographs, 1.0)
        x, z = pillars[int(pillar)]
        angle = np.arctan2(z, x) + np.pi / 2 + 2 * np.pi * share
        eye = np.array([x + REACH * np.cos(angle), -0.3, z + REACH * np.sin(angle)])
        eye += random.normal(0, SHAKE, 3)
        poses.append(look_at(eye, np.array([x, 0.1, z]) + random.normal(0, SWAY, 3)))
    return np.array(poses)


def _pillar(number: int, x: float, z: float) -> tuple[Shape, ...]:
    """Its trunk, a box, and its part of the floor."""
    return (
        Shape("box", (x, 0.0, z), (0.28, 0.9, 0.28), prints(100 + number, 350), 31 * number),
        Shape("box", (x + 0.7, 0.65, z), (0.15, 0.25, 0.2), prints(300 + number, 200), 17),
        Shape("box", (x, 1.0, z), (1.5, 0.1, 1.5), prints(500 + number, 900, 1) * 6),
    )


def through_run(run: Path, photographs: int, width: int) -> Walk:
    """From one photograph's place to the next, on a smooth way, all along a finished run's."""
    from splatcli.folders import load_target
    from stages.raster.draw import renderer
    from stages.viewer import camera_paths

    splats, pipeline = load_target(run)
    assert pipeline is not None, "a run folder is wanted"
    cameras = [view.camera for view in pipeline.load("sfm").views]
    order = camera_paths.tour(cameras, splats)
    way = camera_paths.interpolated([cameras[i] for i in order], splats, photographs)
    height = round(way[0].height * width / way[0].width)
    cameras = [camera.resized(width, height) for camera in way]
    draw = renderer(splats)

    def photograph(number: int) -> NDArray[np.uint8]:
        return _as_taken(255 * draw(cameras[number]).image[..., ::-1], number)

    return Walk(np.array([camera.world_to_camera for camera in cameras]), photograph)


def _as_taken(drawn: NDArray[np.float32], number: int) -> NDArray[np.uint8]:
    """A lens's blur and a sensor's noise."""
    blurred = cv2.GaussianBlur(np.clip(drawn, 0, 255), (0, 0), BLUR_PX)
    noise = np.random.default_rng(number).normal(0, NOISE, blurred.shape)
    return np.clip(blurred + noise, 0, 255).astype(np.uint8)
