"""python -m tests.readers RUN|FILE: every format, read by everyone who reads it, as a table.

RUN is a finished run folder: what its export would be made from, seen by its held-out cameras.
FILE is any splat file, seen from one side. Nothing is written beside them; --keep FOLDER keeps the
exports and the pictures. What is not installed here is left out, and said.
"""

from __future__ import annotations

import argparse
import tempfile
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

from stages import formats
from stages.evaluate.image_metrics import psnr
from stages.formats.values import drop_undrawable
from stages.proof.checks import read_back
from stages.proof.compare import differences
from stages.raster.draw import render
from stages.run.stages import STAGE_OF
from stages.scene import Camera, Splats, View, look_at, split_held_out
from tests.packages import UnavailableError, installed
from tests.readers.engines import (
    ENGINES,
    Engine,
    camera_for,
    served,
)
from tests.readers.validators import gltf_complaints, usd_complaints
from tests.readers.values import READERS
from tests.viewer.browser import Browser, chromium

SIDE_PX = 480
SIZE = (SIDE_PX, SIDE_PX)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.readers", description=__doc__)
    parser.add_argument("source", type=Path)
    parser.add_argument("--keep", type=Path)
    parser.add_argument("--format", action="append", choices=tuple(formats.FORMATS))
    parser.add_argument("--no-pictures", action="store_true", help="leave out the web engines")
    given = parser.parse_args()
    splats, views = _source(given.source)
    with tempfile.TemporaryDirectory() as temporary:
        folder = given.keep or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        names = given.format or list(formats.FORMATS)
        drawn = [np.clip(render(splats, view.camera).image, 0, 1) for view in views]
        print(f"{len(splats)} splats, {len(views)} cameras, {views[0].camera.width} px wide\n")
        _sizes(splats, views, drawn, folder, names)
        _readers(splats, folder, names)
        _validators(folder, names)
        if not given.no_pictures:
            _engines(views[0].camera, drawn[0], folder, names)


def _source(path: Path) -> tuple[Splats, tuple[View, ...]]:
    """The splats that could be drawn, and up to two views to compare pictures from."""
    if not path.is_dir():
        splats, _ = drop_undrawable(formats.read(path))
        middle = np.median(splats.means, axis=0)
        reach = 2.5 * float(np.median(np.abs(splats.means - middle)))
        eye = middle + reach * np.array([0.6, -0.5, -1.0])
        matrix = look_at(eye, middle)
        camera = Camera(*SIZE, SIDE_PX * 1.1, SIDE_PX * 1.1, SIDE_PX / 2, SIDE_PX / 2, matrix)
        return replace(splats, origin=np.zeros(3)), (View("side", "", camera),)
    reconstruction = STAGE_OF["sfm"].load(path / "2-sfm")
    splats, _ = drop_undrawable(STAGE_OF["quantise"].load(path / "6-quantise").splats)
    training, held = split_held_out(reconstruction.views)
    chosen = held or training
    views = [chosen[0], chosen[len(chosen) // 2]][: len(chosen)]
    return replace(splats, origin=np.zeros(3)), tuple(
        replace(view, camera=view.camera.fitted(SIDE_PX)) for view in views
    )


def _sizes(
    splats: Splats,
    views: tuple[View, ...],
    drawn: list[np.ndarray],
    folder: Path,
    names: list[str],
) -> None:
    print("| format | bytes | bytes a splat | PSNR, drawn again |\n|---|---|---|---|")
    for name in names:
        path = folder / f"scene.{name}"
        formats.write(path, splats, views=views)
        size = formats.FORMATS[name].size_bytes(path)
        found = read_back(path)
        again = [
            render(found.splats, view.camera.moved(found.world_from_file)).image for view in views
        ]
        pairs = zip(again, drawn, strict=True)
        decibels = min(psnr(np.clip(one, 0, 1), ours) for one, ours in pairs)
        text = f"{decibels:.1f} dB" if np.isfinite(decibels) else "same"
        print(f"| `{name}` | {size} | {size / len(splats):.1f} | {text} |", flush=True)


def _readers(splats: Splats, folder: Path, names: list[str]) -> None:
    columns = ("position", "ln scale", "opacity", "rotation", "SH")
    print(f"\n| format | read by | splats | {' | '.join(columns)} |")
    print("|---|---|---|" + "---|" * len(columns))
    for reader in READERS:
        for name in (name for name in reader.formats if name in names):
            try:
                content = reader.read(folder / f"scene.{name}")
            except UnavailableError as reason:
                print(f"| `{name}` | {reader.name}: {reason} |")
                continue
            count = len(content.splats)
            errors = ["-"] * len(columns)
            if count == len(splats):
                errors = [f"{e:.2g}" for e in differences(splats, content, name).largest.values()]
            print(f"| `{name}` | {reader.name} | {count} | {' | '.join(errors)} |", flush=True)


def _validators(folder: Path, names: list[str]) -> None:
    print("\n| format | validator | errors and warnings |\n|---|---|---|")
    for check, who, wanted in (
        (gltf_complaints, "gltf-validator", ("glb", "gltf", "quantised.glb", "spz.glb")),
        (usd_complaints, "usd-core", ("usda", "usdc", "usdz")),
    ):
        for name in (name for name in wanted if name in names):
            try:
                found = check(folder / f"scene.{name}")
            except UnavailableError as reason:
                print(f"| `{name}` | {who} | {reason} |")
                continue
            print(f"| `{name}` | {who} | {'; '.join(found[:3]) or 0} |", flush=True)


def _engines(camera: Camera, ours: np.ndarray, folder: Path, names: list[str]) -> None:
    try:
        packages, program = installed(Path(__file__).parent), chromium()
    except UnavailableError as reason:
        print(f"\nNo pictures: {reason}")
        return
    print("\n| format | drawn by | splats | PSNR against `splat render` | mirrored |")
    print("|---|---|---|---|---|")
    with (
        tempfile.TemporaryDirectory() as profile,
        served(packages, folder) as address,
        closing(Browser(program, Path(profile), (camera.width, camera.height))) as browser,
    ):
        for engine_name, wanted in ENGINES.items():
            for name in (name for name in wanted if name in names):
                try:
                    engine = Engine(browser, address, engine_name)
                    count = engine.open(f"scene.{name}")
                    path = folder / f"scene.{name}"
                    theirs = engine.draw(camera_for(path, camera))
                except AssertionError as failure:
                    print(f"| `{name}` | {engine_name} | {str(failure)[:200]} |")
                    continue
                right, mirrored = psnr(theirs, ours), psnr(theirs[:, ::-1], ours)
                print(
                    f"| `{name}` | {engine_name} | {count} | {right:.1f} dB | {mirrored:.1f} dB |",
                    flush=True,
                )
                beside = np.concatenate([theirs, ours], axis=1)
                Image.fromarray(np.uint8(beside * 255)).save(folder / f"{engine_name}-{name}.png")


if __name__ == "__main__":
    main()
