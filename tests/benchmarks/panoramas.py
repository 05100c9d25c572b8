"""Equirectangular pictures of the sample's scene: `python -m tests.benchmarks.panoramas FOLDER`.

Draws 12 of them along the sample's walk, as a 360-degree camera on a stick would take them: level
to a few degrees, turned anyhow. With `--run RUN` it compares a finished run with the truth: how far
the cameras are off, and how well the splats show the sample's test views, drawn into FOLDER.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from sample_captures import make, render
from sample_captures.render import Array, Light, Shape
from stages.evaluate.evaluation import evaluate_at_sizes, image_renderer
from stages.raster.kernels.simd import kernel
from stages.scene import View, load_splats
from stages.sfm import stage as sfm
from tests.benchmarks.sample_test_views import evaluation_views
from tests.sfm.truth import centres, similarity

PANORAMAS = 12
WIDTH = 3840  # 611 pixels a radian; the sample's photographs have 600
_BAND = 64  # rows that are drawn at once
_TILT_DEG = 4.0
_XMP = (
    b'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-'
    b'syntax-ns#"><rdf:Description xmlns:GPano="http://ns.google.com/photos/1.0/panorama/" '
    b'GPano:ProjectionType="equirectangular"/></rdf:RDF></x:xmpmeta>'
)


@dataclass(frozen=True)
class Band:
    """Rows of an equirectangular picture, in place of a `render.Lens`: columns are longitudes from
    behind over the left to the front in the middle, rows latitudes from up to down."""

    width: int
    height: int
    first: int

    def rays(self, world_to_camera: NDArray[np.float64], dx: float, dy: float) -> Array:
        """[3, H W] unit directions in the world through the points (dx, dy) of each pixel."""
        u, v = np.meshgrid(np.arange(self.width) + dx, self.first + np.arange(self.height) + dy)
        longitude = 2 * np.pi * (u.ravel() / self.width - 0.5)
        down = np.pi * (v.ravel() / (self.width / 2) - 0.5)
        camera = np.stack(
            [np.sin(longitude) * np.cos(down), np.sin(down), np.cos(longitude) * np.cos(down)]
        )
        return (world_to_camera[:3, :3].T @ camera).astype(np.float32)


def poses() -> list[NDArray[np.float64]]:
    """[4, 4] world_to_camera of each: at one of every two places of the sample's walk, in its
    order, low and high in turn."""
    rng = np.random.default_rng(360)
    found = []
    walk = make.poses()
    for number in range(PANORAMAS):
        pose = walk[2 * number + number % 2]
        eye = -pose[:3, :3].T @ pose[:3, 3]
        heading = rng.uniform(0, 2 * np.pi)
        ahead = np.array([np.cos(heading), 0.0, np.sin(heading)])
        level = make.look_at(eye, eye + ahead)
        pitch, roll = np.radians(rng.normal(0, _TILT_DEG / 2, 2))
        turn = np.eye(4)
        turn[:3, :3] = np.array(
            [[np.cos(roll), -np.sin(roll), 0], [np.sin(roll), np.cos(roll), 0], [0, 0, 1]]
        ) @ np.array(
            [[1, 0, 0], [0, np.cos(pitch), -np.sin(pitch)], [0, np.sin(pitch), np.cos(pitch)]]
        )
        found.append(turn @ level)
    return found


def picture(pose: NDArray[np.float64], width: int) -> NDArray[np.uint8]:
    """[W / 2, W, 3] what a panorama shows."""
    return drawn([Band(width, _BAND, first) for first in range(0, width // 2, _BAND)], pose)


def drawn(bands: Sequence[Any], pose: NDArray[np.float64]) -> NDArray[np.uint8]:
    """[H, W, 3] the bands of a picture, one below the other; as `render.photograph`, with compiled
    shadows. bands: each with what `Band` has."""
    render.occluded = _occluded
    shapes = list(make.scene())
    return np.concatenate([render.photograph(shapes, Light(), band, pose) for band in bands])


def draw(number: int, folder: Path, width: int) -> None:
    """Draw one, unless it is in `folder`."""
    path = folder / name(number)
    if not path.exists():
        partial_path = path.with_suffix(".partial")
        Image.fromarray(picture(poses()[number], width)).save(
            partial_path, "JPEG", quality=95, subsampling=0, xmp=_XMP
        )
        partial_path.replace(path)


def _occluded(
    shapes: list[Shape], origins: Array, directions: Array, reach: Array
) -> NDArray[np.bool_]:
    """As `render.occluded`."""
    solid = [shape for shape in shapes if not shape.inside]
    kinds = np.array([("box", "cylinder", "ellipsoid").index(shape.kind) for shape in solid])
    matrices = np.array([shape.to_local() for shape in solid])
    centres = np.array([shape.centre for shape in solid], np.float32)
    radii = np.array([np.linalg.norm(shape.half) for shape in solid], np.float32)
    blocked = np.zeros(origins.shape[1], np.bool_)
    directions = np.ascontiguousarray(directions)
    origins = np.ascontiguousarray(origins)
    _block(kinds, matrices, centres, radii, origins, directions, reach, blocked)
    return blocked


@kernel
def _block(kinds, matrices, centres, radii, origins, directions, reach, blocked):
    o, d = np.empty(3, np.float32), np.empty(3, np.float32)
    for ray in range(len(blocked)):
        for shape in range(len(kinds)):
            along, away = np.float32(0.0), np.float32(0.0)  # of the middle of its bounding sphere
            for k in range(3):
                to = centres[shape, k] - origins[k, ray]
                along += to * directions[k, ray]
                away += to * to
            beyond = radii[shape] * radii[shape]
            if away - along * along > beyond or (along < 0 and away > beyond):
                continue
            for k in range(3):
                o[k], d[k] = 0.0, 0.0
                for j in range(3):
                    m = matrices[shape, k, j]
                    o[k] += m * (origins[j, ray] - centres[shape, j])
                    d[k] += m * directions[j, ray]
                if abs(d[k]) < 1e-9:
                    d[k] = 1e-9
            near, far = -np.inf, np.inf
            if kinds[shape] != 0:
                middle = 1.0 if kinds[shape] == 2 else 0.0  # of an ellipsoid y counts, too
                a = d[0] * d[0] + d[2] * d[2] + middle * d[1] * d[1]
                b = o[0] * d[0] + o[2] * d[2] + middle * o[1] * d[1]
                c = o[0] * o[0] + o[2] * o[2] + middle * o[1] * o[1] - 1.0
                if b * b <= a * c:
                    continue
                root = np.sqrt(b * b - a * c)
                near, far = (-b - root) / a, (-b + root) / a
            for k in range(3):
                if kinds[shape] == 0 or (kinds[shape] == 1 and k == 1):
                    one, other = (-1.0 - o[k]) / d[k], (1.0 - o[k]) / d[k]
                    near, far = max(near, min(one, other)), min(far, max(one, other))
            if near < far and 1e-4 < near < reach[ray]:
                blocked[ray] = True
                break


def name(number: int) -> str:
    return f"pano_{number:02d}.jpg"


def errors_mm(views: Sequence[View]) -> NDArray[np.float64]:
    """[F, 3] of the placed panoramas' positions, millimetres."""
    found = {view.frame: view.camera.world_to_camera for view in views}
    true = dict(zip(map(name, range(PANORAMAS)), poses(), strict=True))
    have, there = centres(np.array([*found.values()])), centres(np.array([true[f] for f in found]))
    turn, scale, shift = similarity(have, there)
    return np.asarray(1000 * (scale * have @ turn.T + shift - there))


def compare(run: Path, drawn: Path) -> str:
    """The figures of a finished run; also of one of the sample's photographs. drawn: folder of the
    sample's test views."""
    reconstruction = sfm.load(run / "2-sfm")
    panoramas = bool(reconstruction.views[0].frame)
    truth = dict(zip(map(name, range(PANORAMAS)), poses(), strict=True)) if panoramas else None
    text = f"{len(reconstruction.views)} views"
    if panoramas:
        away = np.linalg.norm(errors_mm(reconstruction.views), axis=1)
        text += f", {len(away)} placed, {away.mean():.3f} ({away.max():.3f}) mm off"
    for stage in (s for s in ("4-train", "5-prune") if (run / s / "splats.bin").is_file()):
        splats = load_splats(run / stage / "splats.bin")
        views = evaluation_views(drawn, reconstruction, splats.draw_settings, truth)
        scores = evaluate_at_sizes(image_renderer(splats, "auto"), views)["full"]
        found = [score.psnr_db for score in scores]
        text += f"\n{stage}: {len(splats)} splats, test views {np.mean(found):.2f} dB"
        text += f", worst {min(found):.2f}"
    return text


def main(words: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--width", type=int, default=WIDTH, help="of a picture (pixels)")
    parser.add_argument("--run", type=Path, help="a finished run to compare with the truth")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    options = parser.parse_args(words)
    if options.run:
        print(compare(options.run, options.folder))
        return
    options.folder.mkdir(parents=True, exist_ok=True)
    one = partial(draw, folder=options.folder, width=options.width)
    with ProcessPoolExecutor(options.jobs) as pool:
        list(pool.map(one, range(PANORAMAS)))


if __name__ == "__main__":
    main()
