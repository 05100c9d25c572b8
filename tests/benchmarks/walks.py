"""Cameras of long walks against the truth: `python -m tests.benchmarks.walks FOLDER --photos 50`.

Draws photographs on a walk once around each of several pillars in a hall, one pillar for every 25
photographs, which at the end comes back to the first; noise, a little blur, JPEG. Finds their
cameras, and prints CPU seconds (of all processes), what was placed, and how far from the truth.
Photographs are kept in FOLDER.
"""

from __future__ import annotations

import argparse
import resource
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from sample_captures.make import look_at
from sample_captures.render import Lens, Shape
from stages import ingest, sfm
from stages.base.stage import Report
from tests.structure.rooms import picture, prints
from tests.structure.truth import centres, similarity

AROUND = 25  # photographs of a pillar
APART, REACH = 3.0, 1.6  # metres between pillars, and from a pillar to the camera
LENS = Lens(width=400, height=300, focal_px=270.0, k=0.0)
BLUR_PX = 0.6
QUALITY = 90
_STEPS = ("features", "matching", "mapping")
TOLD = (
    "points",
    *(f"pairs_{what}" for what in ("looked_at", "matched", "verified")),
    *(f"{step}_seconds" for step in _STEPS),
)


def places(photographs: int) -> NDArray[np.float64]:
    """[M, 2] x and z of the pillars: on a ring."""
    count = max(2, round(photographs / AROUND))
    radius = APART / (2 * np.sin(np.pi / count))
    angles = 2 * np.pi * np.arange(count) / count
    return radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)


def walk(photographs: int) -> NDArray[np.float64]:
    """[P, 4, 4] world_to_camera, held by hand: around each pillar in turn."""
    random = np.random.default_rng(3)
    pillars = places(photographs)
    poses = []
    for number in range(photographs):
        pillar, share = divmod(number * len(pillars) / photographs, 1.0)
        x, z = pillars[int(pillar)]
        angle = np.arctan2(z, x) + np.pi / 2 + 2 * np.pi * share
        eye = np.array([x + REACH * np.cos(angle), -0.3, z + REACH * np.sin(angle)])
        eye += random.normal(0, 0.04, 3)
        poses.append(look_at(eye, np.array([x, 0.1, z]) + random.normal(0, 0.06, 3)))
    return np.array(poses)


def hall(photographs: int) -> list[tuple[Shape, ...]]:
    """What stands at each pillar: its trunk, a box, and its part of the floor."""
    found: list[tuple[Shape, ...]] = []
    for number, (x, z) in enumerate(places(photographs)):
        found.append(
            (
                Shape(
                    "box", (x, 0.0, z), (0.28, 0.9, 0.28), prints(100 + number, 350), 31 * number
                ),
                Shape("box", (x + 0.7, 0.65, z), (0.15, 0.25, 0.2), prints(300 + number, 200), 17),
                Shape("box", (x, 1.0, z), (1.5, 0.1, 1.5), prints(500 + number, 900, 1) * 6),
            )
        )
    return found


def take(photographs: int, folder: Path) -> None:
    """Draw and save the photographs that are not there yet."""
    folder.mkdir(parents=True, exist_ok=True)
    pillars, standing = places(photographs), hall(photographs)
    backdrop = Shape("box", (0.0, 0.0, 0.0), (200.0, 3.0, 200.0), prints(1, 64), inside=True)
    for number, pose in enumerate(walk(photographs)):
        path = folder / f"{number:04d}.jpg"
        if path.exists():
            continue
        eye = -pose[:3, :3].T @ pose[:3, 3]
        near = np.argsort(np.linalg.norm(pillars - eye[[0, 2]], axis=1))[:3]
        seen = [backdrop, *(shape for pillar in near for shape in standing[pillar])]
        blurred = cv2.GaussianBlur(picture(seen, pose, LENS), (0, 0), BLUR_PX)
        cv2.imencode(".jpg", blurred, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1].tofile(path)


def used() -> float:
    """CPU seconds of this process and of those that it waited for."""
    both = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(usage.ru_utime + usage.ru_stime for usage in both)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--photos", type=int, nargs="+", default=[50, 100, 200, 400])
    options = parser.parse_args()
    for count in options.photos:
        folder: Path = options.folder / str(count)
        take(count, folder / "photos")
        settings = ingest.IngestSettings()
        capture = ingest.run({"photos": folder / "photos"}, settings, folder / "1", Report())
        before, report = used(), Report()
        found = sfm.run({"ingest": capture}, sfm.SfmSettings(), folder / "2", report)
        seconds = used() - before
        numbers = [int(Path(view.name).stem) for view in found.views]
        true = centres(walk(count)[numbers])
        have = centres(np.array([view.camera.world_to_camera for view in found.views]))
        turn, scale, shift = similarity(have, true)
        away = np.linalg.norm(scale * have @ turn.T + shift - true, axis=1)
        figures = {name: report.metrics[name] for name in TOLD}
        print(
            f"{count}: {seconds:.0f} CPU s, {len(numbers)} placed, "
            f"{1000 * away.mean():.1f} ({1000 * away.max():.1f}) mm off, {figures}",
            flush=True,
        )


if __name__ == "__main__":
    main()
