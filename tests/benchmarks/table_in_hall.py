"""The sample's table in a hall of 20 times its size: `python -m tests.benchmarks.table_in_hall`.

An ordinary walk around an object shows far more than the object: here a hall with windows in its
walls, and trees and hills outside. All cameras are known. Some pictures are taken where no
photograph stood, to test with: between the photographs, nearer, farther and higher. The command
draws all pictures into OUT/images, and writes OUT/transforms.json, for

    splat process OUT/images --cameras OUT/transforms.json --split

Surfaces have the colours of their textures, without light, and a little noise.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from sample_captures import make, textures
from sample_captures.make import look_at
from sample_captures.render import Array, Lens, Shape, hit, surface
from stages.cameras.nerfstudio import write
from stages.scene import Camera, Reconstruction, View
from tests.benchmarks.caster import Boxes
from tests.benchmarks.phone_depth import true_depth

WIDTH = 320
BACKGROUND_M = 8.0  # what is deeper in a picture is background: no part of the table or its carpet
OUTSIDE_M = 26.0  # what is deeper lies outside the windows: the hall ends before
PHOTOGRAPHS = 28
RINGS = ((-0.34, 1.42), (-0.74, 1.28))  # (y, distance from the axis) of the walk's two heights
# (y, distance from the axis, degrees around it) of test views, metres; the farther ones from three
# times the distance.
TEST_PLACES = {
    "between": ((-0.5, 1.35, 45.0), (-0.6, 1.3, 174.0)),
    "nearer": ((-0.5, 0.9, 100.0), (-0.45, 0.85, 290.0)),
    "farther": ((-0.5, 4.2, 20.0), (-0.7, 4.1, 140.0), (-0.9, 4.2, 255.0)),
    "higher": ((-1.6, 1.2, 70.0), (-1.5, 1.3, 220.0)),
}
NOISE = 1.5  # of 255
POINTS = 6000
_MIDDLE = (2.0, -1.5)  # x and z of the hall's; the table stands at the origin
_HALF = 17.2  # of the hall: 20 times the table's
_FLOOR, _SILL, _LINTEL, _CEILING = 0.75, -0.25, -3.75, -6.25  # y
_THICK = 0.15  # half of a wall
_WINDOWS, _PIER = 3, 4.0  # of each wall; width of what stands between them, metres
_TEXELS = 20.0  # a metre, of walls: about the pixels that photographs of WIDTH have there
_PARTS = 2  # sub-samples of a pixel, each way
_SHAKE_M = 0.03  # of the hand, and of what it aims at

Poses = Mapping[str, NDArray[np.float64]]


def lens(width: int = WIDTH) -> Lens:
    """As wide as a phone's: 67 degrees."""
    return Lens(width=width, height=width * 3 // 4, focal_px=0.75 * width, k=0.0)


def walk() -> Poses:
    """World to camera of the photographs by name: once around the table, low and high in turn, held
    by hand."""
    rng = np.random.default_rng(17)
    found = {}
    for place in range(PHOTOGRAPHS):
        y, distance = RINGS[place % 2]
        eye = _eye(y, distance, 360.0 * place / PHOTOGRAPHS) + rng.normal(0, _SHAKE_M, 3)
        target = np.array(make.TARGET) + rng.normal(0, _SHAKE_M, 3)
        found[f"walk_{place:02d}.png"] = look_at(eye, target)
    return found


def held_out_poses() -> Poses:
    """World to camera of the test views by name: their group and a number."""
    return {
        f"{group}_{number}.png": look_at(_eye(*place), np.array(make.TARGET))
        for group, places in TEST_PLACES.items()
        for number, place in enumerate(places)
    }


def _eye(y: float, distance: float, degrees: float) -> NDArray[np.float64]:
    angle = np.radians(degrees)
    return np.array([distance * np.cos(angle), y, distance * np.sin(angle)])


def picture(pose: NDArray[np.float64], width: int = WIDTH) -> NDArray[np.uint8]:
    """[H, W, 3] RGB: what a camera at `pose` (world to camera) sees. It stands in the hall, where
    nothing hides the table."""
    near, covered = _table_picture(pose, lens(width))
    drawn = near + (1 - covered) * _ready_hall().picture(pose, lens(width))
    noise = np.random.default_rng(int(1e6 * abs(pose[:3, 3].sum()))).normal(0, NOISE, drawn.shape)
    return np.rint(np.clip(drawn + noise, 0, 255)).astype(np.uint8)


def _table_picture(pose: NDArray[np.float64], through: Lens) -> tuple[Array, Array]:
    """(colours [H, W, 3] in 0..255, times the share of the pixel that the table covers [H, W, 1];
    that share)."""
    eye = (-pose[:3, :3].T @ pose[:3, 3]).astype(np.float32)[:, None]
    colour = np.zeros((3, through.width * through.height), np.float32)
    covered = np.zeros(colour.shape[1], np.float32)
    scene = table()
    for part in range(_PARTS**2):
        dx, dy = (np.array(divmod(part, _PARTS)) + 0.5) / _PARTS
        rays = through.rays(pose, dx, dy)
        reach = np.stack([hit(shape, eye, rays) for shape in scene])
        nearest, seen = reach.argmin(0), np.isfinite(reach.min(0))
        for number, shape in enumerate(scene):
            mine = np.flatnonzero(seen & (nearest == number))
            if len(mine):
                points = eye + rays[:, mine] * reach[number, mine]
                colour[:, mine] += surface(shape, points)[1] * np.float32(255 / _PARTS**2)
        covered += seen / np.float32(_PARTS**2)
    size = through.height, through.width
    return colour.T.reshape(*size, 3), covered.reshape(*size, 1)


def depth(pose: NDArray[np.float64], width: int = WIDTH) -> NDArray[np.float32]:
    """[H, W] z of what each pixel's middle shows, metres."""
    return true_depth([*table(), *hall()], lens(width), pose)


def shows_background(pose: NDArray[np.float64], width: int = WIDTH) -> NDArray[np.bool_]:
    """[H, W] the pixels that show the far floor, the walls, or what lies outside the windows."""
    return depth(pose, width) > BACKGROUND_M


def shows_outside(pose: NDArray[np.float64], width: int = WIDTH) -> NDArray[np.bool_]:
    """[H, W] the pixels that show trees and hills through the windows."""
    return depth(pose, width) > OUTSIDE_M


@cache
def table() -> tuple[Shape, ...]:
    """The sample's table and what stands on it. Textures are reduced to the pixels that small
    pictures have, so that detail below a pixel does not flicker."""
    return tuple(
        replace(shape, faces=tuple(_reduced(face, 4) for face in shape.faces))
        for shape in make.scene()[1:]  # the first is its room
    )


@cache
def hall() -> tuple[Shape, ...]:
    """Floor, carpet, ceiling, walls with windows, and what is outside."""
    rng = np.random.default_rng(41)
    x, z = _MIDDLE
    floor = _reduced(textures.worn(rng, textures.wood(rng, 1400, 1400, 0.8), 0.2), 2)
    ceiling = textures.printed(rng, 350, 350, [textures.COOL[2], textures.WARM[2]] * 2, shapes=200)
    carpet = textures.printed(rng, 500, 500, textures.GARDEN, lines=6, shapes=200)
    return (
        Shape("box", (x, _FLOOR + 0.1, z), (_HALF, 0.1, _HALF), (floor,) * 6),
        Shape("box", (0.2, _FLOOR, -0.3), (2.4, 0.01, 2.2), (carpet,) * 6, 25),
        Shape("box", (x, _CEILING - 0.1, z), (_HALF, 0.1, _HALF), (ceiling,) * 6),
        *(shape for side in range(4) for shape in _wall(rng, side)),
        *_outside(rng),
    )


@cache
def _ready_hall() -> Boxes:
    return Boxes(hall())


def _wall(rng: np.random.Generator, side: int) -> Iterator[Shape]:
    """The boxes of one wall: below its windows, above them and between them."""
    colours = (textures.WARM, textures.COOL, textures.GARDEN)[side % 3]
    bay = 2 * _HALF / _WINDOWS
    yield _part_of_wall(rng, side, colours, (-_HALF, _HALF), (_SILL, _FLOOR))
    yield _part_of_wall(rng, side, colours, (-_HALF, _HALF), (_CEILING, _LINTEL))
    for pier in range(_WINDOWS + 1):
        middle = -_HALF + pier * bay
        ends = max(-_HALF, middle - _PIER / 2), min(_HALF, middle + _PIER / 2)
        yield _part_of_wall(rng, side, colours, ends, (_LINTEL, _SILL))


def _part_of_wall(
    rng: np.random.Generator,
    side: int,
    colours: list[tuple[float, float, float]],
    along: tuple[float, float],
    heights: tuple[float, float],
) -> Shape:
    """A part of the wall on `side` (0 to 3), from `along` to `along` and between two y."""
    rows, columns = (int(_TEXELS * (b - a)) for a, b in (heights, along))
    shapes = int(20 * max(1.0, columns / rows))
    face = textures.printed(rng, rows, columns, colours, lines=rows // 40, shapes=shapes)
    plain = np.full((2, 2, 3), 0.55, np.float32)  # of the reveals
    out = (_HALF + _THICK) * (1 if side < 2 else -1)
    middle, half = sum(along) / 2, (along[1] - along[0]) / 2
    y, high = sum(heights) / 2, (heights[1] - heights[0]) / 2
    x, z = _MIDDLE
    if side % 2:
        faces = (plain,) * 4 + (face,) * 2
        return Shape("box", (x + middle, y, z + out), (half, high, _THICK), faces)
    faces = (face,) * 2 + (plain,) * 4
    return Shape("box", (x + out, y, z + middle), (_THICK, high, half), faces)


def _outside(rng: np.random.Generator) -> Iterator[Shape]:
    """Hills and sky at 120 m, a meadow, and trees 28 to 55 m away."""
    hills = textures.ramp(
        textures.fractal(rng, 160, 320, cells=(3, 5), persistence=0.5),
        [(0.35, 0.50, 0.62), (0.62, 0.74, 0.84), (0.93, 0.94, 0.95)],
    )
    yield Shape("box", (0.0, -20.0, 0.0), (120.0, 60.0, 120.0), (hills,) * 6, inside=True)
    meadow = textures.printed(rng, 700, 700, textures.GARDEN, shapes=300)
    yield Shape("box", (0.0, _FLOOR + 1.0, 0.0), (119.0, 0.5, 119.0), (meadow,) * 6)
    bark = textures.wood(rng, 64, 64, 0.7)
    for angle in np.radians(np.arange(0, 360, 20) + rng.uniform(-6, 6, 18)):
        distance, size = rng.uniform(28, 55), rng.uniform(1.5, 3.0)
        x, z = distance * np.cos(angle), distance * np.sin(angle)
        crown = textures.printed(rng, 48, 48, textures.GARDEN, shapes=40)
        yaw = rng.uniform(0, 90)
        yield Shape("box", (x, -0.75, z), (0.3, 1.6, 0.3), (bark,) * 6)
        yield Shape("box", (x, -2.3 - size, z), (size, size, size), (crown,) * 6, yaw)


def _reduced(face: Array, by: int) -> Array:
    height, width = (max(8, side // by) for side in face.shape[:2])
    return np.asarray(cv2.resize(face, (width, height), interpolation=cv2.INTER_AREA), np.float32)


def points(count: int = POINTS) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """(points [P, 3] of the surfaces, their colours [P, 3]), as seen through random pixels of the
    photographs, near and far alike."""
    rng = np.random.default_rng(11)
    through, found, colours = lens(), [], []
    scene, photographs = [*table(), *hall()], walk()
    for number, pose in enumerate(photographs.values()):
        share = count // len(photographs) + (number < count % len(photographs))
        eye = (-pose[:3, :3].T @ pose[:3, 3]).astype(np.float32)[:, None]
        chosen = rng.choice(through.width * through.height, share, replace=False)
        rays = through.rays(pose, 0.5, 0.5)[:, chosen]
        reach = np.stack([hit(shape, eye, rays) for shape in scene])
        at = eye + rays * reach.min(0)
        colour = np.zeros_like(at)
        for row in np.unique(reach.argmin(0)):
            mine = np.flatnonzero(reach.argmin(0) == row)
            colour[:, mine] = surface(scene[row], at[:, mine])[1]
        found.append(at.T)
        colours.append(np.rint(255 * colour.T))
    return np.concatenate(found).astype(np.float64), np.concatenate(colours).astype(np.uint8)


def capture(folder: Path, width: int = WIDTH) -> Reconstruction:
    """The photographs and test views, drawn into `folder`, with their exact cameras, and points of
    the surfaces."""
    folder.mkdir(parents=True, exist_ok=True)
    views = []
    for role, poses in (("train", walk()), ("test", held_out_poses())):
        for name, pose in poses.items():
            Image.fromarray(picture(pose, width)).save(folder / name)
            views.append(View(name, name, _camera(pose, width), role=role))
    where, colours = points()
    return Reconstruction(
        folder=folder,
        views=tuple(views),
        points=where,
        colours=colours,
        errors_px=np.full(len(where), 0.5),
        tracks=np.full(len(where), 3, np.int32),
        units="metres",
        levelled=True,
    )


def of_walk(made: Reconstruction) -> Reconstruction:
    """The capture without its test views, as a user has it: every eighth photograph is held out.

    Test views count for the extent of a scene, which the farther ones triple.
    """
    photographs = (replace(view, role="") for view in made.views if view.role == "train")
    return replace(made, views=tuple(photographs))


def of_test(made: Reconstruction) -> tuple[View, ...]:
    """Its test views."""
    return tuple(view for view in made.views if view.role == "test")


def _camera(pose: NDArray[np.float64], width: int) -> Camera:
    through = lens(width)
    size, focal = (through.width, through.height), through.focal_px
    return Camera(*size, focal, focal, through.width / 2, through.height / 2, pose)


def write_cameras(path: Path, made: Reconstruction) -> None:
    """transforms.json as `--cameras` reads it, with the split that `--split` uses and the points
    beside it."""
    write(path, made.views, made.folder, made.points, made.colours)
    data = json.loads(path.read_text(encoding="utf-8"))
    for view, frame in zip(made.views, data["frames"], strict=True):
        data.setdefault(f"{view.role}_filenames", []).append(frame["file_path"])
    path.write_text(json.dumps(data, indent=1), encoding="utf-8")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--width", type=int, default=WIDTH, help="of the pictures, pixels")
    given = parser.parse_args()
    made = capture(given.out / "images", given.width)
    write_cameras(given.out / "transforms.json", made)
    print(f"{len(made.views)} pictures in {made.folder}")


if __name__ == "__main__":
    main()
