"""Fisheye pictures of the sample's scene: `python -m tests.benchmarks.fisheyes FOLDER`.

Draws 12 circular ones of 180 degrees, or `--degrees`, along the sample's walk into FOLDER/photos,
and their cameras, equidistant, as a COLMAP model into FOLDER/cameras. With `--run RUN` it compares
the splats of a finished run with the held-out pictures, within and beyond what one pinhole picture
of them shows.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from sample_captures import make
from sample_captures.render import Array
from stages.base.stage import Report
from stages.cameras.lens import Lens
from stages.cameras.undistortion import undistorted_camera
from stages.evaluate.evaluation import image_renderer
from stages.evaluate.image_metrics import capped_psnr_db
from stages.scene import Camera, Photo, load_splats
from stages.scene.capture import HELD_OUT_EVERY
from stages.scene.pictures import load_image
from stages.scene.rotations import quaternions_of
from stages.sfm.known.pinhole_views import PinholeView, write_pinhole_views
from stages.sfm.undistorted_images import IMAGES, PosedPhoto, mask_file
from tests.benchmarks import panoramas

SIDE = 800  # pixels; 255 a radian
DEGREES = 180.0  # across a picture
_BAND = 80  # rows that are drawn at once


@dataclass(frozen=True)
class Band:
    """Rows of a square equidistant picture, in place of a `render.Lens`."""

    width: int
    height: int
    first: int
    degrees: float

    def rays(self, world_to_camera: NDArray[np.float64], dx: float, dy: float) -> Array:
        """[3, H W] unit directions in the world through the points (dx, dy) of each pixel."""
        whole = directions(self.width, self.degrees, dx, dy)
        rays = whole[self.first : self.first + self.height]
        return (world_to_camera[:3, :3].T @ rays.reshape(-1, 3).T).astype(np.float32)


def directions(side: int, degrees: float, dx: float = 0.5, dy: float = 0.5) -> NDArray[np.float64]:
    """[S, S, 3] unit directions of the camera through the points (dx, dy) of each pixel."""
    u, v = np.meshgrid(np.arange(side) + dx - side / 2, np.arange(side) + dy - side / 2)
    angle = np.minimum(np.radians(degrees) / side * np.hypot(u, v), np.pi)
    turn = np.arctan2(v, u)
    return np.stack([np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle)], -1)


def poses() -> list[NDArray[np.float64]]:
    """[4, 4] world_to_camera of each: every second of the sample's walk, low and high in turn."""
    walk = make.poses()
    return [walk[2 * number + number % 2] for number in range(panoramas.PANORAMAS)]


def name(number: int) -> str:
    return f"fisheye_{number:02d}.jpg"


def picture(pose: NDArray[np.float64], side: int, degrees: float) -> NDArray[np.uint8]:
    """[S, S, 3] what a fisheye shows: black beyond half of `degrees` from its axis."""
    bands = [Band(side, _BAND, first, degrees) for first in range(0, side, _BAND)]
    shown = panoramas.drawn(bands, pose)
    inside = directions(side, degrees)[..., 2:] > np.cos(np.radians(degrees) / 2)
    return np.where(inside, shown, np.uint8(0))


def draw(number: int, folder: Path, side: int, degrees: float = DEGREES) -> None:
    """Draw one, unless it is in `folder`."""
    path = folder / name(number)
    if not path.exists():
        unfinished = path.with_suffix(".partial")
        pixels = picture(poses()[number], side, degrees)
        Image.fromarray(pixels).save(unfinished, "JPEG", quality=95, subsampling=0)
        unfinished.replace(path)


def taken(number: int, side: int, degrees: float = DEGREES) -> Camera:
    """The camera of a picture; its lens is equidistant."""
    focal = side / np.radians(degrees)
    return Camera(side, side, focal, focal, side / 2, side / 2, poses()[number])


def compare(run: Path, photos: Path, degrees: float = DEGREES) -> str:
    """Of the trained splats of a run: PSNR of the held-out pictures within what one pinhole picture
    shows, and beyond. Each figure is of all pixels of the picture's faces."""
    splats = load_splats(run / "4-train" / "splats.bin")
    figures = json.loads((run / "2-sfm" / "sfm.json").read_text(encoding="utf-8"))["metrics"]
    draw = image_renderer(splats, "auto")
    lines = [f"{len(splats)} splats, {figures['registered_images']} views"]
    for number in range(0, panoramas.PANORAMAS, HELD_OUT_EVERY):
        side = Image.open(photos / name(number)).width
        camera = taken(number, side, degrees)
        one = undistorted_camera(camera, Lens("fisheye"))
        parts: dict[str, list[tuple[Array, Array]]] = {"within": [], "beyond": []}
        with TemporaryDirectory() as folder:
            for view in cut(number, camera, photos, Path(folder)):
                c = view.camera
                shown = np.clip(draw(c.moved(np.array(figures["file_from_world"]))), 0.0, 1.0)
                truth = load_image(Path(folder) / IMAGES / view.photo.picture, c.width, c.height)
                inside = seen_by(one, view)
                kept = kept_of(view, Path(folder))
                parts["within"].append((shown[inside & kept], truth[inside & kept]))
                parts["beyond"].append((shown[~inside & kept], truth[~inside & kept]))
        found = {
            k: [np.concatenate(x)[:, None] for x in zip(*v, strict=True)] for k, v in parts.items()
        }
        text = (
            f"{k} one pinhole picture {capped_psnr_db(*pair):.2f} dB" for k, pair in found.items()
        )
        lines.append(f"{name(number)}: {', '.join(text)}")
    return "\n".join(lines)


def cut(number: int, camera: Camera, photos: Path, folder: Path) -> list[PinholeView]:
    """The faces of a picture, written to `folder`."""
    side = camera.width
    photo = Photo(name(number), name(number), side, side, None, "fisheye", 1.0, 0.0, None)
    posed = [PosedPhoto(photo, camera, Lens("fisheye"))]
    return write_pinhole_views(posed, photos, folder, Report())


def seen_by(one: Camera, view: PinholeView) -> NDArray[np.bool_]:
    """[H, W] which pixels of a face the pinhole camera `one`, at the same place, shows."""
    c = view.camera
    x, y = np.meshgrid(np.arange(c.width) + 0.5 - c.cx, np.arange(c.height) + 0.5 - c.cy)
    rays = np.stack([x / c.fx, y / c.fy, np.ones_like(x)], axis=-1) @ view.rotation
    pixels, z = replace(one, world_to_camera=np.eye(4)).project(rays.reshape(-1, 3))
    return np.asarray((one.shows(pixels) & (z > 0)).reshape(x.shape))


def kept_of(view: PinholeView, folder: Path) -> NDArray[np.bool_]:
    """[H, W] which pixels of a face its photograph shows."""
    size = view.camera.width, view.camera.height
    if not view.photo.mask:
        return np.ones((size[1], size[0]), np.bool_)
    return np.asarray(load_image(folder / mask_file(view.photo), *size)[..., 0] > 0)


def write_cameras(folder: Path, side: int, degrees: float = DEGREES) -> None:
    """A COLMAP model of the pictures' cameras, as text and without points."""
    folder.mkdir(parents=True, exist_ok=True)
    camera = taken(0, side, degrees)
    lens = f"{camera.fx} {camera.fy} {camera.cx} {camera.cy} 0 0 0 0"
    (folder / "cameras.txt").write_text(f"1 OPENCV_FISHEYE {side} {side} {lens}\n")
    lines = []
    for number, pose in enumerate(poses()):
        words = [number + 1, *quaternions_of(pose[:3, :3]), *pose[:3, 3], 1, name(number)]
        lines.append(" ".join(map(str, words)) + "\n\n")
    (folder / "images.txt").write_text("".join(lines))


def main(words: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--side", type=int, default=SIDE, help="of a picture (pixels)")
    parser.add_argument("--degrees", type=float, default=DEGREES, help="across a picture")
    parser.add_argument("--run", type=Path, help="a finished run of the pictures in FOLDER")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    options = parser.parse_args(words)
    photos = options.folder / "photos"
    if options.run:
        print(compare(options.run, photos, options.degrees))
        return
    photos.mkdir(parents=True, exist_ok=True)
    write_cameras(options.folder / "cameras", options.side, options.degrees)
    one = partial(draw, folder=photos, side=options.side, degrees=options.degrees)
    with ProcessPoolExecutor(options.jobs) as pool:
        list(pool.map(one, range(panoramas.PANORAMAS)))


if __name__ == "__main__":
    main()
