"""Make the sample captures: `python -m sample_captures.make` (a few minutes on two cores).

Renders photographs of a scene that is known exactly, with EXIF like a camera's, and writes the
truth beside them. Everything comes from fixed seeds; README.md says what to expect.
"""

from __future__ import annotations

import argparse
import io
import json
import os
from concurrent.futures import ProcessPoolExecutor
from functools import cache, partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from sample_captures import textures as tx
from sample_captures.render import Array, Lens, Light, Shape, hit, photograph

HERE = Path(__file__).resolve().parent
LENS = Lens(width=640, height=480, focal_px=600.0, k=-0.045)
FOCAL_35MM = 34  # EXIF keeps whole millimetres: 34 stands for 604 px, 0.7 % off the truth
JPEG_QUALITY = 90
RINGS = ((-0.34, 1.42), (-0.86, 1.28))  # (y, distance from the axis) of the two heights, metres
PHOTOGRAPHS = 24
ARC_DEGREES = 230.0
FIRST = 4  # place on the arc; so the 1st, 9th and 17th, often held out, have neighbours both sides
TARGET = (0.0, -0.12, 0.0)


def box_faces(rng: np.random.Generator, size: int, colours: Any, lines: int) -> tuple[Array, ...]:
    return tuple(tx.printed(rng, size, size, colours, lines=lines, shapes=45) for _ in range(6))


def block(rng: np.random.Generator, colours: Any, letters: str) -> tuple[Array, ...]:
    """Six faces of a toy block, each with a large letter."""
    faces = []
    for letter in letters:
        face = tx.printed(rng, 256, 256, colours, shapes=25)
        with tx.drawing_on(face) as canvas:
            for colour, thick in ((tx.WARM[2], 26), (colours[-1], 13)):
                cv2.putText(canvas, letter, (52, 206), 3, 7.0, tx.rgb(colour), thick, cv2.LINE_AA)
            cv2.rectangle(canvas, (6, 6), (249, 249), tx.rgb(colours[0]), 9)
        faces.append(tx.worn(rng, face, 0.18))
    return tuple(faces)


def cylinder_faces(side: Array, cap: Array) -> tuple[Array, ...]:
    return side, cap, cap


def room(rng: np.random.Generator) -> list[Shape]:
    """The walls, the floor and the table."""
    tints = [(0.62, 0.66, 0.62), (0.72, 0.60, 0.50), (0.56, 0.63, 0.70), (0.70, 0.66, 0.54)]
    left, right, front, back = (tx.wall(rng, 1000, 1900, tint) for tint in tints)
    ceiling = tx.wall(rng, 400, 400, (0.8, 0.8, 0.78))
    floor = tx.worn(rng, tx.wood(rng, 1600, 1600, 0.7), 0.2)
    walls = (left, right, ceiling, floor, front, back)
    top = tx.table_top(rng, 1600)
    rim = tx.wood(rng, 64, 2048, 0.8)
    return [
        Shape("box", (0.0, -0.75, 0.2), (2.9, 1.5, 2.7), walls, inside=True),
        Shape("cylinder", (0, 0.02, 0), (0.86, 0.02, 0.86), cylinder_faces(rim, top), gloss=0.05),
        Shape("cylinder", (0, 0.40, 0), (0.09, 0.36, 0.09), cylinder_faces(rim, rim)),
    ]


def objects(rng: np.random.Generator) -> list[Shape]:
    """What stands on the table, near and far, low and high."""
    books = [box_faces(rng, 512, colours, 6) for colours in (tx.WARM, tx.COOL, tx.GARDEN)]
    plum = [(0.45, 0.10, 0.20), (0.80, 0.30, 0.25), (0.95, 0.80, 0.55), (0.16, 0.06, 0.12)]
    teal = [(0.05, 0.35, 0.38), (0.10, 0.52, 0.50), (0.90, 0.86, 0.70), (0.03, 0.14, 0.20)]
    citrus = [(0.93, 0.52, 0.10), (0.98, 0.67, 0.15), (0.85, 0.36, 0.07), (0.45, 0.55, 0.15)]
    return [
        Shape("box", (-0.30, -0.030, 0.16), (0.21, 0.030, 0.15), books[0], 24),
        Shape("box", (-0.31, -0.085, 0.15), (0.17, 0.025, 0.13), books[1], -11),
        Shape("box", (-0.29, -0.128, 0.16), (0.14, 0.018, 0.10), books[2], 39),
        Shape("ellipsoid", (-0.30, -0.251, 0.16), (0.105, 0.105, 0.105),
              (tx.planet(rng, 512, 1024),), 0, gloss=0.10, shininess=30),
        Shape("ellipsoid", (0.02, -0.13, -0.22), (0.13, 0.13, 0.13),
              (tx.glaze(rng, 512, 1024, plum),), 70, gloss=0.85, shininess=110),
        Shape("ellipsoid", (0.30, -0.15, 0.20), (0.13, 0.15, 0.13),
              (tx.glaze(rng, 640, 1024, teal, 7),), 15, gloss=0.35, shininess=60),
        Shape("cylinder", (0.30, -0.32, 0.20), (0.055, 0.06, 0.055),
              cylinder_faces(tx.glaze(rng, 256, 700, teal), tx.glaze(rng, 128, 128, plum)),
              gloss=0.35, shininess=60),
        Shape("cylinder", (0.40, -0.095, -0.17), (0.085, 0.095, 0.085),
              cylinder_faces(tx.printed(rng, 400, 1100, tx.WARM, lines=5, shapes=120),
                             tx.printed(rng, 256, 256, tx.COOL, shapes=30)), 0, gloss=0.12),
        Shape("box", (-0.32, -0.055, -0.25), (0.055, 0.055, 0.055),
              block(rng, tx.WARM, "AKRSTE"), 18),
        Shape("box", (-0.44, -0.055, -0.15), (0.055, 0.055, 0.055),
              block(rng, tx.COOL, "PLQHMB"), -32),
        Shape("box", (-0.375, -0.160, -0.205), (0.05, 0.05, 0.05),
              block(rng, tx.GARDEN, "NOVUZG"), 47),
        Shape("ellipsoid", (0.16, -0.052, -0.46), (0.055, 0.052, 0.055),
              (tx.glaze(rng, 300, 600, citrus, 3),), 30, gloss=0.18, shininess=25),
        Shape("ellipsoid", (0.03, -0.048, -0.52), (0.050, 0.048, 0.050),
              (tx.glaze(rng, 300, 600, citrus[::-1], 3),), 200, gloss=0.18, shininess=25),
        Shape("box", (0.02, -0.16, 0.44), (0.19, 0.16, 0.03), box_faces(rng, 640, tx.COOL, 9), -8),
    ]  # fmt: skip


@cache
def scene() -> tuple[Shape, ...]:
    rng = np.random.default_rng(20240611)
    return (*room(rng), *objects(rng))


def look_at(eye: NDArray[np.float64], target: NDArray[np.float64]) -> NDArray[np.float64]:
    """[4, 4] world_to_camera: x right, y down, z forward; up is -y."""
    z = (target - eye) / np.linalg.norm(target - eye)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([x, np.cross(z, x), z])
    matrix[:3, 3] = -matrix[:3, :3] @ eye
    return matrix


def poses() -> list[NDArray[np.float64]]:
    """Cameras on an arc, low and high in turn, held by hand: each strays a little. In the order of
    the photographs, which begin within the arc, go on to its end and then take the rest."""
    rng = np.random.default_rng(7)
    matrices = []
    for place in range(PHOTOGRAPHS):
        height, distance = RINGS[place % 2]
        angle = np.radians(-90 + ARC_DEGREES * (place / (PHOTOGRAPHS - 1) - 0.5))
        eye = np.array([distance * np.cos(angle), height, distance * np.sin(angle)])
        eye += rng.normal(0, 0.02, 3)
        matrices.append(look_at(eye, np.array(TARGET) + rng.normal(0, 0.03, 3)))
    return matrices[FIRST:] + matrices[:FIRST]


def exif(index: int) -> bytes:
    """What a camera would write: fixed exposure, fixed focal length, fixed dates."""
    tags = Image.Exif()
    tags[0x010F], tags[0x0110] = "Splat", "Ray caster 1"  # Make, Model
    tags[0x0112] = 1  # Orientation: upright
    when = f"2024:06:11 10:{index // 6:02d}:{index % 6 * 10:02d}"
    tags[0x0132] = when
    details = tags.get_ifd(0x8769)
    details[0x829A] = IFDRational(1, 60)  # ExposureTime, seconds
    details[0x829D] = IFDRational(56, 10)  # FNumber
    details[0x8827] = 200  # ISOSpeedRatings
    details[0x9003] = when  # DateTimeOriginal
    details[0x920A] = IFDRational(85, 10)  # FocalLength, millimetres
    details[0xA405] = FOCAL_35MM
    return tags.tobytes()


def name(index: int) -> str:
    return f"IMG_{index + 1:04d}.jpg"


def take(index: int, folder: Path) -> None:
    """Render and save one photograph."""
    picture = photograph(list(scene()), Light(), LENS, poses()[index])
    data = io.BytesIO()
    Image.fromarray(picture).save(data, "JPEG", quality=JPEG_QUALITY, exif=exif(index))
    (folder / name(index)).write_bytes(data.getvalue())


def visible_points(count: int) -> NDArray[np.float64]:
    """[count, 3] points of the surfaces, as seen through random pixels of random photographs."""
    rng = np.random.default_rng(11)
    matrices, shapes = poses(), scene()
    points = []
    for index, matrix in enumerate(matrices):
        share = count // len(matrices) + (index < count % len(matrices))
        eye = (-matrix[:3, :3].T @ matrix[:3, 3]).astype(np.float32)
        chosen = rng.choice(LENS.width * LENS.height, share, replace=False)
        rays = LENS.rays(matrix, 0.5, 0.5)[:, chosen]
        reach = np.stack([hit(shape, eye[:, None], rays) for shape in shapes]).min(0)
        points.append((eye[:, None] + rays * reach).T)
    return np.concatenate(points).astype(np.float64)


def truth() -> dict[str, Any]:
    """The truth as plain data; README.md describes the fields."""
    return {
        "units": "metres",
        "up": [0, -1, 0],
        "camera": {
            "model": "SIMPLE_RADIAL",
            "width": LENS.width,
            "height": LENS.height,
            "f": LENS.focal_px,
            "cx": LENS.width / 2,
            "cy": LENS.height / 2,
            "k": LENS.k,
        },
        "photos": [
            {"name": name(i), "world_to_camera": np.round(matrix, 9).tolist()}
            for i, matrix in enumerate(poses())
        ],
        "points": np.round(visible_points(2400), 5).tolist(),
    }


def as_json(data: dict[str, Any]) -> str:
    """One line per photograph and per point, so that differences can be read."""
    lines = [
        f" {json.dumps(key)}: "
        + (
            "[\n  " + ",\n  ".join(json.dumps(row) for row in value) + "\n ]"
            if key in ("photos", "points")
            else json.dumps(value)
        )
        for key, value in data.items()
    ]
    return "{\n" + ",\n".join(lines) + "\n}\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=HERE / "still_life")
    parser.add_argument("--only", type=int, nargs="*", help="photographs to render (from 0)")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    options = parser.parse_args()
    images = options.out / "images"
    images.mkdir(parents=True, exist_ok=True)
    wanted = range(PHOTOGRAPHS) if options.only is None else options.only
    with ProcessPoolExecutor(options.jobs) as pool:
        for number, _ in enumerate(pool.map(partial(take, folder=images), wanted), 1):
            print(f"{number} of {len(wanted)} photographs", flush=True)
    (options.out / "truth.json").write_text(as_json(truth()), encoding="utf-8")


if __name__ == "__main__":
    main()
