"""Levels of detail where they are used: `python -m tests.benchmarks.levels FILE [FEWEST]`.

Each level is drawn from three sides, from as far away as its splats are a pixel wide (two standard
deviations of the median splat), and compared with the full scene, both antialiased. The last
columns have the full scene drawn four times as fine and averaged as the truth.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from stages import formats
from stages.editing import levels
from stages.evaluate.image_metrics import capped_psnr_db
from stages.raster.draw import raster_settings_of, renderer
from stages.scene import Camera, Splats, look_at
from stages.scene.framing import orbit_cameras

FINER = 4
_SMALLEST_PX, _LARGEST_PX = 64, 500


def cameras(full: Splats, level: Splats) -> Iterator[Camera]:
    """Three, that see all but the outskirts."""
    middle = np.median(full.means, axis=0).astype(np.float64)
    reach = float(np.percentile(np.linalg.norm(full.means - middle, axis=1), 90))
    size = 2 * float(np.median(np.exp(level.log_scales.max(axis=1))))
    for camera in orbit_cameras(full, 3, 0.5):
        focal = camera.fx
        away = (camera.centre - middle) / np.linalg.norm(camera.centre - middle) * size * focal
        wide = 4 * focal * reach / (size * focal)
        side = int(np.clip(wide, _SMALLEST_PX, _LARGEST_PX))
        pose = look_at(middle + away, middle)
        yield Camera(side, side, focal, focal, side / 2, side / 2, pose)


def truth_of(full: Splats, camera: Camera, settings: Any) -> np.ndarray:
    fine = camera.resized(FINER * camera.width, FINER * camera.height)
    image = renderer(full, settings)(fine).image
    found: np.ndarray = image.reshape(camera.height, FINER, camera.width, FINER, 3).mean((1, 3))
    return np.clip(found, 0, 1)


def main(path: Path, fewest: int = 2000) -> None:
    """fewest: no level follows one of so many; by default there are more than an asset has."""
    levels._FEWEST = fewest
    full = formats.read(path)
    plain = raster_settings_of(full)
    smooth = replace(plain, antialias=True)
    print("| splats | full | as sharp: full, level | without antialiasing: full, level |")
    print("|--:|--:|--:|--:|")
    for level in levels.coarser_levels(full):
        rows = []
        for camera in cameras(full, level):
            truth = truth_of(full, camera, smooth)
            whole = np.clip(renderer(full, smooth)(camera).image, 0, 1)
            drawn = renderer(level, smooth)(camera).image
            row = [
                capped_psnr_db(drawn, whole),
                capped_psnr_db(whole, truth),
                capped_psnr_db(drawn, truth),
            ]
            row += [capped_psnr_db(renderer(s, plain)(camera).image, truth) for s in (full, level)]
            rows.append(row)
        a, b, c, d, e = np.mean(rows, axis=0)
        print(f"| {len(level):,} | {a:.1f} | {b:.1f}, {c:.1f} | {d:.1f}, {e:.1f} |")


if __name__ == "__main__":
    main(Path(sys.argv[1]), *map(int, sys.argv[2:]))
