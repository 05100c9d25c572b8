"""What measured depth gains: `python -m tests.benchmarks.phone_depth --out FOLDER`.

The sample, or with --plain the same scene with bare walls and without its light, with and without
depth maps as a phone's sensor has them: 256 x 192 pixels; noise that grows with distance and is
alike in neighbouring pixels, an error of scale for each map, depths between two surfaces at edges,
and holes at edges, on dark surfaces and beyond the sensor's range. Training alone, evaluated on the
twelve hidden views. Photographs and cameras are kept in FOLDER.
"""

from __future__ import annotations

import argparse
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from sample_captures import make
from sample_captures.render import Lens, Shape, hit
from stages.base.stage import Report
from stages.evaluate.evaluation import evaluate, image_renderer, load_evaluation_views
from stages.ingest.settings import IngestSettings
from stages.run.pipeline import Pipeline
from stages.run.stages import STAGE_OF
from stages.scene import Splats, draw_settings_of, evenly_spaced
from stages.train.settings import PRESETS
from tests.benchmarks.sample_test_views import PINHOLE, held_out_views_in, poses, render_test_views
from tests.sample import PHOTOS
from tests.sfm.room_captures import picture

WIDTH, HEIGHT = 256, 192
NOISE_M, NOISE = 0.003, 0.01  # standard deviation: metres, and share of the depth
SCALE_ERROR = 0.005  # standard deviation over maps
RANGE_M = 5.0
DARK = 40  # of 255
EDGE = 0.05  # relative difference of depth between neighbours
_ALIKE_PX = 1.5  # over which noise is alike


def true_depth(
    scene: Sequence[Shape], lens: Lens, pose: NDArray[np.float64]
) -> NDArray[np.float32]:
    """[H, W] z of the nearest surface at each pixel's centre, metres."""
    eye = (-pose[:3, :3].T @ pose[:3, 3]).astype(np.float32)[:, None]
    rays = lens.rays(pose, 0.5, 0.5)
    reach = np.min([hit(shape, eye, rays) for shape in scene], axis=0)
    return np.asarray((reach * (pose[2, :3] @ rays)).reshape(lens.height, lens.width), np.float32)


def phone_depth(
    depth: NDArray[np.float32], picture: NDArray[np.uint8], rng: np.random.Generator
) -> NDArray[np.uint16]:
    """[192, 256] millimetres measured, from the true depth [H, W] and its photograph [H, W, 3]."""
    size = (WIDTH, HEIGHT)
    near = cv2.resize(depth, size, interpolation=cv2.INTER_AREA)  # means of both sides of an edge
    grey = cv2.resize(picture.mean(2).astype(np.float32), size, interpolation=cv2.INTER_AREA)
    noise = cv2.GaussianBlur(rng.normal(size=(HEIGHT, WIDTH)), (0, 0), _ALIKE_PX)
    noise += 0.3 * rng.normal(size=noise.shape) * noise.std()
    found = near * (1 + rng.normal() * SCALE_ERROR)
    found = found + (NOISE_M + NOISE * near) * noise / noise.std()
    spread = cv2.dilate(near, np.ones((3, 3))) / cv2.erode(near, np.ones((3, 3))) - 1
    patches = cv2.GaussianBlur(rng.normal(size=(HEIGHT, WIDTH)), (0, 0), 3.0)
    holes = (spread > EDGE) & (patches > 0)  # at half of the edges; the others stay wrong
    holes |= (grey < DARK) | (near > RANGE_M)
    return np.where(holes, 0, np.round(1000 * found)).astype(np.uint16)


def write_phone_depth(
    folder: Path, photographs: Sequence[Path], scene: Sequence[Shape], seed: int = 0
) -> None:
    """A 16-bit .png in millimetres for each of these photographs of the sample, with its stem."""
    folder.mkdir(parents=True, exist_ok=True)
    for path in photographs:
        index = int(path.stem.split("_")[1]) - 1
        depth = true_depth(scene, make.LENS, make.poses()[index])
        shown = np.asarray(cv2.imread(str(path)), np.uint8)
        measured = phone_depth(depth, shown, np.random.default_rng([seed, index]))
        cv2.imwrite(str(folder / f"{path.stem}.png"), measured)


def bare_walls() -> list[Shape]:
    """The sample with walls and a ceiling of one colour."""
    room, *rest = make.scene()
    bare = np.full((8, 8, 3), (0.66, 0.64, 0.60), np.float32)
    floor = 3
    faces = tuple(face if i == floor else bare for i, face in enumerate(room.faces))
    return [replace(room, faces=faces), *rest]


def draw(folder: Path, scene: Sequence[Shape]) -> None:
    """All photographs and hidden views of a scene that are not there yet, without light."""
    photos = [(make.LENS, f"photos/{make.name(i)}", pose) for i, pose in enumerate(make.poses())]
    hidden = [(PINHOLE, f"test_views/test_{i:02d}.png", pose) for i, pose in enumerate(poses())]
    for lens, name, pose in (*photos, *hidden):
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if not path.exists():
            shown = Image.fromarray(picture(scene, pose, lens)[..., ::-1])
            shown.save(path, quality=make.JPEG_QUALITY, exif=make.exif(0))


def seeded(folder: Path, count: int, scene: Sequence[Shape], depth: bool) -> Pipeline:
    """A run of `count` of the photographs, up to the seeds."""
    every = sorted((folder / "photos").iterdir())
    chosen = folder / f"photos-{count}"
    if not chosen.exists():
        chosen.mkdir()
        for path in evenly_spaced(every, count):
            shutil.copyfile(path, chosen / path.name)
        write_phone_depth(folder / f"sensor-{count}", sorted(chosen.iterdir()), scene)
    pipeline = Pipeline(folder / f"run-{count}{'-depth' * depth}", chosen)
    settings = IngestSettings(depth=folder / f"sensor-{count}" if depth else None)
    pipeline.run({"ingest": settings}, until="seed")
    return pipeline


def psnr_db(pipeline: Pipeline, folder: Path, preset: str, seed: int) -> list[float]:
    """Of each hidden view, after training alone."""
    inputs = {name: pipeline.load(name) for name in ("sfm", "seed")}
    settings = replace(PRESETS[preset], seed=seed)
    work = pipeline.run_folder / f"{preset}-{seed}"
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir()
    splats: Splats = STAGE_OF["train"].run(inputs, settings, work, Report()).splats
    drawn = replace(splats.draw_settings, side=settings.train_side)
    views = load_evaluation_views(
        folder / "test_views",
        held_out_views_in(inputs["sfm"]),
        draw_settings_of(inputs["sfm"], settings.train_side),
    )
    scores = evaluate(image_renderer(replace(splats, draw_settings=drawn), "auto"), views)
    return [score.psnr_db for score in scores]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--plain", action="store_true", help="walls and ceiling of one colour")
    parser.add_argument("--photographs", type=int, nargs="+", default=[10, 24])
    parser.add_argument("--preset", default="preview", choices=list(PRESETS))
    parser.add_argument("--seeds", type=int, default=2)
    given = parser.parse_args()
    scene = bare_walls() if given.plain else list(make.scene())
    folder = given.out / ("plain" if given.plain else "sample")
    if given.plain:
        draw(folder, scene)
    else:
        shutil.copytree(PHOTOS, folder / "photos", dirs_exist_ok=True)
        render_test_views(folder / "test_views")
    for count in given.photographs:
        for seed in range(given.seeds):
            for depth in (False, True):
                pipeline = seeded(folder, count, scene, depth)
                found = psnr_db(pipeline, folder, given.preset, seed)
                print(
                    f"{count} photographs, {'depth' if depth else 'no depth'}, seed {seed}: "
                    f"mean {np.mean(found):.2f}, worst {min(found):.2f} dB",
                    flush=True,
                )


if __name__ == "__main__":
    main()
