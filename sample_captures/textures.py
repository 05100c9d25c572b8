"""Procedural textures for the sample captures: 8-bit RGB images that repeat nowhere.

Every texture mixes noise of many octaves, so that it carries detail near and far, with printed
shapes in distinct colours, so that feature matching has no excuse to confuse two places.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.float32]  # [H, W, 3] in 0..1, sRGB values
Field = NDArray[np.float32]  # [H, W], roughly 0..1

WARM = [(0.82, 0.26, 0.18), (0.95, 0.68, 0.25), (0.93, 0.87, 0.74), (0.36, 0.14, 0.17)]
COOL = [(0.11, 0.32, 0.50), (0.28, 0.62, 0.66), (0.90, 0.91, 0.86), (0.13, 0.16, 0.31)]
GARDEN = [(0.23, 0.43, 0.22), (0.66, 0.74, 0.32), (0.94, 0.88, 0.62), (0.80, 0.38, 0.40)]
WORDS = [
    "STILL",
    "LIFE",
    "LIGHT",
    "PAPER",
    "CLAY",
    "RIVER",
    "ORBIT",
    "QUARTZ",
    "FABLE",
    "MUSIC",
    "THYME",
    "NORTH",
    "VELVET",
    "GRAIN",
    "AMBER",
    "COMET",
    "SALT",
    "PLUM",
]


def fractal(
    rng: np.random.Generator,
    height: int,
    width: int,
    *,
    cells: tuple[int, int] = (4, 4),
    persistence: float = 0.62,
) -> Field:
    """Value noise summed over octaves until a cell is about two texels wide; [H, W] in 0..1."""
    total = np.zeros((height, width), np.float32)
    weight = 1.0
    rows, columns = cells
    while rows < height / 2 or columns < width / 2:
        grid = rng.random((min(rows, height) + 3, min(columns, width) + 3), dtype=np.float32)
        total += weight * cv2.resize(grid, (width, height), interpolation=cv2.INTER_CUBIC)
        weight *= persistence
        rows, columns = rows * 2, columns * 2
    low, high = np.percentile(total, [1, 99])
    return np.clip((total - low) / max(float(high - low), 1e-6), 0, 1).astype(np.float32)


def ramp(field: Field, colours: list[tuple[float, float, float]]) -> Image:
    """Colours laid along 0..1 and interpolated."""
    stops = np.linspace(0, 1, len(colours))
    table = np.array(colours)
    return np.stack([np.interp(field, stops, table[:, c]) for c in range(3)], -1).astype(np.float32)


def mosaic(
    rng: np.random.Generator,
    height: int,
    width: int,
    tiles: int,
    colours: list[tuple[float, float, float]],
    joint: float = 1.6,
) -> Image:
    """Irregular tiles (nearest random seed) with dark joints about 2 x `joint` texels wide."""
    seeds = np.full((height, width), 255, np.uint8)
    seeds[rng.integers(0, height, tiles), rng.integers(0, width, tiles)] = 0
    _, labels = cv2.distanceTransformWithLabels(
        seeds, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    shade = rng.random((labels.max() + 1, 1)) * 0.35 + 0.75
    table = np.array(colours)[rng.integers(0, len(colours), labels.max() + 1)] * shade
    flat = np.ones((height, width), np.uint8)
    flat[:, 1:] &= (labels[:, 1:] == labels[:, :-1]).astype(np.uint8)
    flat[1:] &= (labels[1:] == labels[:-1]).astype(np.uint8)
    inside = np.clip(cv2.distanceTransform(flat, cv2.DIST_L2, 5) / joint, 0, 1)[..., None]
    return (table[labels] * (0.25 + 0.75 * inside)).clip(0, 1).astype(np.float32)


@contextmanager
def drawing_on(image: Image) -> Iterator[NDArray[np.uint8]]:
    """An 8-bit copy to draw on (OpenCV smooths edges only there), written back to `image`."""
    canvas = np.round(image * 255).astype(np.uint8)
    yield canvas
    image[:] = canvas / np.float32(255)


def rgb(colour: tuple[float, float, float]) -> tuple[float, float, float]:
    """A colour in 0..1 as OpenCV wants it on 8-bit pictures."""
    return (colour[0] * 255, colour[1] * 255, colour[2] * 255)


def worn(rng: np.random.Generator, image: Image, amount: float = 0.25) -> Image:
    """The image with uneven print: multiplied by noise of all scales."""
    height, width = image.shape[:2]
    noise = fractal(rng, height, width, cells=(6, 6), persistence=0.8)
    return (image * (1 - amount + 2 * amount * (noise[..., None] - 0.15))).clip(0, 1)


def lettering(
    rng: np.random.Generator, image: Image, lines: int, colour: tuple[float, float, float]
) -> None:
    """Draw `lines` lines of words and a few ornaments into `image`, in place."""
    height, width = image.shape[:2]
    with drawing_on(image) as canvas:
        for row in range(lines):
            size = height / lines
            scale = size / 60 * rng.uniform(0.7, 1.2)
            text = " ".join(rng.choice(WORDS, 3))
            origin = (int(rng.uniform(0, 0.25) * width), int((row + 0.7) * size))
            thick = max(1, round(scale * rng.uniform(1.5, 4)))
            font = int(rng.integers(0, 4))
            cv2.putText(canvas, text, origin, font, scale, rgb(colour), thick, cv2.LINE_AA)


def confetti(
    rng: np.random.Generator,
    image: Image,
    count: int,
    colours: list[tuple[float, float, float]],
    radius: tuple[float, float] = (0.008, 0.05),
) -> None:
    """Draw random ellipses, rings and triangles into `image`, in place; radii in image heights."""
    height, width = image.shape[:2]
    with drawing_on(image) as canvas:
        for _ in range(count):
            colour = rgb(colours[rng.integers(len(colours))])
            centre = np.array([rng.uniform(0, width), rng.uniform(0, height)])
            reach = height * np.exp(rng.uniform(*np.log(radius)))
            kind = rng.integers(3)
            if kind == 2:
                turn = rng.uniform(0, 2 * np.pi) + np.array([0, 2.1, 4.2])
                turn += rng.uniform(-0.5, 0.5, 3)
                corners = centre + reach * np.stack([np.cos(turn), np.sin(turn)], 1)
                cv2.fillPoly(canvas, [np.round(corners).astype(np.int32)], colour, cv2.LINE_AA)
                continue
            axes = (max(1, round(reach)), max(1, round(reach * rng.uniform(0.4, 1))))
            thick = -1 if kind == 0 else max(1, round(reach * 0.25))
            middle = (round(centre[0]), round(centre[1]))
            tilt = rng.uniform(0, 180)
            cv2.ellipse(canvas, middle, axes, tilt, 0, 360, colour, thick, cv2.LINE_AA)


def printed(
    rng: np.random.Generator,
    height: int,
    width: int,
    colours: list[tuple[float, float, float]],
    *,
    lines: int = 0,
    shapes: int = 60,
) -> Image:
    """Cardboard with a printed pattern, lettering and wear."""
    image = ramp(fractal(rng, height, width, persistence=0.7), colours[:3])
    confetti(rng, image, shapes, colours)
    if lines:
        lettering(rng, image, lines, colours[-1])
    return worn(rng, image)


def wood(rng: np.random.Generator, height: int, width: int, tone: float = 1.0) -> Image:
    """Planks along x with grain, knots and joints."""
    planks = 7
    image = np.zeros((height, width, 3), np.float32)
    edges = np.linspace(0, height, planks + 1).astype(int)
    for top, bottom in pairwise(edges):
        rows = bottom - top
        bend = fractal(rng, rows, width, cells=(2, 5), persistence=0.45)
        grain = 0.5 + 0.5 * np.sin(40 * bend + 18 * fractal(rng, rows, width, cells=(16, 3)))
        fine = fractal(rng, rows, width, cells=(64, 24), persistence=0.8)
        plank = ramp(
            0.45 * grain + 0.55 * fine, [(0.40, 0.25, 0.14), (0.62, 0.42, 0.25), (0.80, 0.61, 0.41)]
        )
        image[top:bottom] = plank * rng.uniform(0.75, 1.15) * tone
        image[top : top + max(1, height // 500)] *= 0.3
    return image.clip(0, 1)


def table_top(rng: np.random.Generator, size: int) -> Image:
    """Wood with a round printed mat of mosaic rings in the middle."""
    image: NDArray[np.floating] = wood(rng, size, size)
    axis = (np.arange(size, dtype=np.float32) + 0.5) / size * 2 - 1
    radius = np.hypot(axis[None, :], axis[:, None])
    rings = [
        (0.74, printed(rng, size, size, COOL, lines=26, shapes=900)),
        (0.60, mosaic(rng, size, size, 2600, WARM)),
        (0.44, printed(rng, size, size, [COOL[2], WARM[1], GARDEN[1], COOL[3]], shapes=1600)),
        (0.27, mosaic(rng, size, size, 6000, COOL + GARDEN)),
    ]
    for limit, ring in rings:
        inside = np.clip((limit - radius) * size / 4 + 0.5, 0, 1)[..., None]
        image = image * (1 - inside) + worn(rng, ring, 0.15) * inside
    return image.astype(np.float32)


def wall(rng: np.random.Generator, height: int, width: int, tint: tuple[float, ...]) -> Image:
    """Plaster with blotches of many sizes and a row of framed pictures."""
    base = np.array(tint)
    colours = [tuple(base * 0.62), tuple(base), tuple(np.clip(base * 1.25, 0, 1))]
    image = ramp(fractal(rng, height, width, cells=(3, 3), persistence=0.72), colours)
    confetti(rng, image, 500, [*colours, (0.45, 0.40, 0.38)], (0.002, 0.012))
    for slot in range(5):
        w, h = int(width * rng.uniform(0.10, 0.15)), int(height * rng.uniform(0.24, 0.40))
        x = int(width * (slot + 0.5) / 5 - w / 2 + rng.uniform(-0.02, 0.02) * width)
        y = int(height * rng.uniform(0.22, 0.38))
        palette = [WARM, COOL, GARDEN][int(rng.integers(3))]
        picture = mosaic(rng, h, w, int(rng.integers(40, 300)), palette)
        if slot % 2:
            picture = printed(rng, h, w, palette, lines=5)
        frame = max(6, h // 16)
        image[y - frame : y + h + frame, x - frame : x + w + frame] = rng.uniform(0.1, 0.4)
        image[y : y + h, x : x + w] = picture
    return image.clip(0, 1).astype(np.float32)


def planet(rng: np.random.Generator, height: int, width: int) -> Image:
    """A globe: land and sea from noise taken on the sphere, so that the seam does not show."""
    longitude = (np.arange(width, dtype=np.float32) + 0.5) / width * 2 * np.pi
    latitude = (np.arange(height, dtype=np.float32) + 0.5) / height * np.pi
    cosine = np.sin(latitude)[:, None]
    xyz = (cosine * np.cos(longitude), np.cos(latitude)[:, None] + 0 * longitude,
           cosine * np.sin(longitude))  # fmt: skip
    land = np.zeros((height, width), np.float32)
    for octave in range(6):
        sheet = fractal(rng, 512, 512, cells=(3 * 2**octave, 3 * 2**octave), persistence=0.3)
        for a, b in ((0, 1), (1, 2), (2, 0)):
            u, v = ((xyz[i] * 250 + 256).astype(np.float32) for i in (a, b))
            land += 0.62**octave * cv2.remap(sheet, u, v, cv2.INTER_LINEAR)
    land = (land - land.min()) / np.ptp(land)
    sea = ramp(np.clip(land / 0.5, 0, 1), [(0.05, 0.13, 0.30), (0.15, 0.42, 0.62)])
    ground = ramp(
        np.clip((land - 0.5) / 0.4, 0, 1),
        [(0.87, 0.80, 0.55), (0.34, 0.52, 0.22), (0.55, 0.38, 0.24), (0.95, 0.95, 0.95)],
    )
    image = np.where((land > 0.5)[..., None], ground, sea)
    confetti(rng, image, 160, [(0.85, 0.2, 0.15), (0.95, 0.9, 0.8), (0.1, 0.1, 0.15)],
             (0.004, 0.014))  # fmt: skip
    return worn(rng, image.astype(np.float32), 0.12)


def glaze(
    rng: np.random.Generator,
    height: int,
    width: int,
    colours: list[tuple[float, float, float]],
    bands: int = 5,
) -> Image:
    """Ceramic glaze: bands that run and drip, with speckles."""
    drip = fractal(rng, height, width, cells=(3, 10), persistence=0.6)
    rows = np.linspace(0, bands, height, dtype=np.float32)[:, None]
    level = np.floor(rows + 1.4 * drip).astype(int) % len(colours)
    image = np.array(colours, np.float32)[level]
    confetti(rng, image, 700, [colours[-1], (0.96, 0.93, 0.85)], (0.002, 0.009))
    return worn(rng, image, 0.2)
