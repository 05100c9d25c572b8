"""Captures that cannot be reconstructed, made from the photographs of the sample capture."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from stages.scene import Capture, Photo

SAMPLE = Path(__file__).parents[3] / "sample_captures" / "still_life" / "images"


def sample(count: int | None = None) -> Capture:
    """The sample capture, or its first photographs."""
    names = sorted(path.name for path in SAMPLE.glob("*.jpg"))[:count]
    return Capture(SAMPLE, tuple(_photo(name, *_size(SAMPLE / name)) for name in names))


def capture_of(folder: Path, images: dict[str, np.ndarray]) -> Capture:
    """Write `images` as PNG into `folder` and describe them."""
    folder.mkdir(parents=True, exist_ok=True)
    photos = []
    for name, image in sorted(images.items()):
        assert cv2.imwrite(str(folder / name), image)
        photos.append(_photo(name, image.shape[1], image.shape[0]))
    return Capture(folder, tuple(photos))


def pictures(count: int | None = None, step: int = 1) -> list[np.ndarray]:
    """Photographs of the sample capture, [480, 640, 3] uint8."""
    return [_read(path) for path in sorted(SAMPLE.glob("*.jpg"))[::step][:count]]


def two_scenes(folder: Path, each: int = 8) -> Capture:
    """Photographs and mirror images of others: to SIFT a mirrored scene is another scene."""
    scene = pictures(2 * each)
    images = {f"a{i}.png": image for i, image in enumerate(scene[:each])}
    images |= {f"b{i}.png": image[:, ::-1] for i, image in enumerate(scene[each:])}
    return capture_of(folder, images)


def turning_on_the_spot(folder: Path, count: int = 30) -> Capture:
    """What a camera sees that only turns: homographies K R K^-1 of one photograph."""
    image = pictures(1)[0]
    focal, width, height = 600.0, 400, 300
    to_rays = np.linalg.inv(np.array([[focal, 0, 320], [0, focal, 240], [0, 0, 1]]))
    to_pixels = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    random = np.random.default_rng(0)
    images = {}
    for i in range(count):
        turn = cv2.Rodrigues(random.uniform(-0.15, 0.15, 3))[0]
        warped = cv2.warpPerspective(image, to_pixels @ turn @ to_rays, (width, height))
        noisy = warped + random.normal(0, 2, warped.shape)
        images[f"{i:02d}.png"] = np.clip(noisy, 0, 255).astype(np.uint8)
    return capture_of(folder, images)


def blank(folder: Path, count: int = 6) -> Capture:
    """A smooth wall with sensor noise."""
    random = np.random.default_rng(0)
    wall = np.tile(np.linspace(120, 140, 320), (240, 1))[..., None]
    return capture_of(
        folder,
        {
            f"{i}.png": np.clip(wall + random.normal(0, 1.5, (240, 320, 3)), 0, 255).astype(
                np.uint8
            )
            for i in range(count)
        },
    )


def sky(folder: Path, count: int = 8) -> Capture:
    """Two layers of clouds that drift."""
    random = np.random.default_rng(0)
    grains = (random.normal(0, 1, (12, 16)), random.normal(0, 1, (24, 32)))
    layers = [cv2.resize(grain, (640, 480), interpolation=cv2.INTER_CUBIC) for grain in grains]
    images = {}
    for i in range(count):
        far, near = (layer[5 * i :, 9 * k * i :][:300, :400] for k, layer in enumerate(layers, 1))
        clouds = 160 + 30 * far + 15 * near + random.normal(0, 1.5, far.shape)
        images[f"{i}.png"] = np.clip(clouds[..., None] + (60, 20, 0), 0, 255).astype(np.uint8)
    return capture_of(folder, images)


def crowd(folder: Path, count: int = 10) -> Capture:
    """Pieces of a photograph in place of people, each of which goes its own way."""
    random = np.random.default_rng(0)
    scene = pictures(1)[0]
    places, steps = random.uniform(0, 1, (14, 2)), random.uniform(-0.06, 0.06, (14, 2))
    images = {}
    for i in range(count):
        picture = np.full((300, 400, 3), 190, np.uint8)
        for k, (x, y) in enumerate((places + i * steps) % 1):
            left, top = int(350 * x), int(180 * y)
            piece = scene[20 * k : 20 * k + 120, 40 * k : 40 * k + 50]
            picture[top : top + len(piece), left : left + piece.shape[1]] = piece
        images[f"{i}.png"] = picture
    return capture_of(folder, images)


def date_stamp(folder: Path, count: int = 12) -> Capture:
    """Small steps around a scene, with the same large date in every picture."""
    images = {}
    for i, image in enumerate(pictures(count, step=2)):
        for row in range(4):
            place = (330, 360 + 35 * row)
            cv2.putText(image, "2026-07-11 12:3", place, 0, 1.2, (0, 140, 255), 3, cv2.LINE_AA)
        images[f"{i:02d}.png"] = image
    return capture_of(folder, images)


def zooming(folder: Path, count: int = 12) -> Capture:
    """One place, ever closer: crops of one photograph, enlarged to one size."""
    image = pictures(1)[0]
    images = {}
    for i in range(count):
        half = np.array([320, 240]) * (1 - 0.04 * i)
        x, y = (np.array([320, 240]) - half).astype(int)
        images[f"{i:02d}.png"] = cv2.resize(image[y : 480 - y, x : 640 - x], (640, 480))
    return capture_of(folder, images)


def zooming_into_detail(folder: Path, count: int = 10) -> Capture:
    """One place, closer to a half: crops of 16 photographs side by side, which show detail at each
    zoom. COLMAP finds a flat poster, and triangulation angles of several degrees."""
    row = [np.hstack(pictures(16)[i : i + 4]) for i in range(0, 16, 4)]
    image = np.vstack(row)
    images = {}
    for i in range(count):
        x, y = (round(side / 4 * i / (count - 1)) for side in (2560, 1920))
        crop = image[y : 1920 - y, x : 2560 - x]
        images[f"{i:02d}.png"] = cv2.resize(crop, (800, 600), interpolation=cv2.INTER_AREA)
    return capture_of(folder, images)


def duplicates(folder: Path, count: int = 10) -> Capture:
    """One photograph many times, with other noise in each."""
    image = pictures(1)[0]
    random = np.random.default_rng(0)
    return capture_of(
        folder,
        {
            f"{i}.png": np.clip(image + random.normal(0, 3, image.shape), 0, 255).astype(np.uint8)
            for i in range(count)
        },
    )


def _size(path: Path) -> tuple[int, int]:
    height, width = _read(path).shape[:2]
    return width, height


def _read(path: Path) -> np.ndarray:
    image = cv2.imread(str(path))
    assert image is not None
    return image


def _photo(name: str, width: int, height: int) -> Photo:
    return Photo(
        name=name,
        image=name,
        width=width,
        height=height,
        focal_px=None,
        camera=f"{width}x{height}",
        sharpness=1.0,
        log2_luminance=-2.0,
        exposure_ev=None,
    )
