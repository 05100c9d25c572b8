"""360-degree pictures are recognised, and ordinary ones twice as wide as high are not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from stages import ingest
from stages.base.errors import SplatError
from stages.base.stage import Report
from stages.photos.panorama import panorama, projection_of
from tests.structure.bad_captures import SAMPLE

WIDTH = 512


def sphere(seed: int = 0, width: int = WIDTH) -> np.ndarray:
    """[W / 2, W, 3] uint8 of a made scene: waves over the directions of the whole sphere."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[: width // 2, :width] + 0.5
    longitude, latitude = 2 * np.pi * x / width, np.pi * (0.5 - 2 * y / width)
    direction = np.stack(
        [
            np.cos(latitude) * np.cos(longitude),
            np.cos(latitude) * np.sin(longitude),
            np.sin(latitude),
        ],
        axis=-1,
    )
    waves = [
        np.sin(direction @ rng.normal(0, 6, 3) + rng.uniform(0, 6))[..., None]
        * rng.uniform(0, 1, 3)
        for _ in range(12)
    ]
    return np.clip(128 + 30 * np.sum(waves, axis=0), 0, 255).astype(np.uint8)


def size(pixels: np.ndarray) -> tuple[int, int]:
    return pixels.shape[1], pixels.shape[0]


def cropped(path: Path) -> np.ndarray:
    """A photograph cut to twice its height."""
    pixels = np.asarray(Image.open(path).convert("RGB"))
    height = pixels.shape[1] // 2
    top = (len(pixels) - height) // 2
    return pixels[top : top + height, : 2 * height]


@pytest.mark.parametrize("seed", range(5))
def test_a_picture_of_the_whole_sphere_is_a_panorama(seed: int) -> None:
    pixels = sphere(seed)
    assert panorama(pixels, size(pixels), "") == "a 360-degree panorama (equirectangular)"


@pytest.mark.parametrize("seed", range(5))
def test_half_a_sphere_and_other_ratios_are_none(seed: int) -> None:
    pixels = sphere(seed, 1024)
    half = pixels[128:384, :512]
    assert panorama(half, size(half), "") == ""
    wide = pixels[100:400]
    assert panorama(wide, size(wide), "") == ""


def test_ordinary_photographs_twice_as_wide_as_high_are_none() -> None:
    for path in sorted(SAMPLE.glob("*.jpg")):
        pixels = cropped(path)
        assert panorama(pixels, size(pixels), "") == "", path.name


def test_a_wall_without_contrast_is_none() -> None:
    pixels = np.full((256, 512, 3), 180, np.uint8)
    assert panorama(pixels, size(pixels), "") == ""


def test_two_fisheyes_side_by_side_are_named() -> None:
    y, x = np.mgrid[:256, :512] + 0.5
    away = np.minimum(np.hypot(x - 128, y - 128), np.hypot(x - 384, y - 128))
    pixels = np.where((away < 128)[..., None], sphere(3), 0).astype(np.uint8)
    assert panorama(pixels, size(pixels), "") == "a pair of fisheye pictures side by side"


@pytest.mark.parametrize(
    "packet",
    [
        b'<rdf:Description GPano:ProjectionType="equirectangular" GPano:UsePanoramaViewer="True"/>',
        b"<GPano:ProjectionType>equirectangular</GPano:ProjectionType>",
    ],
)
def test_metadata_of_a_photo_sphere_are_enough(packet: bytes) -> None:
    assert projection_of(packet) == "equirectangular"
    assert "as its metadata say" in panorama(
        np.zeros((90, 120, 3), np.uint8), (120, 90), "equirectangular"
    )
    assert projection_of(b"<GPano:Nothing/>") == ""


def test_a_capture_of_panoramas_is_refused_and_says_what_to_do(tmp_path: Path) -> None:
    folder = tmp_path / "photos"
    folder.mkdir()
    for number in range(4):
        Image.fromarray(sphere(number)).save(folder / f"{number}.png")
    with pytest.raises(SplatError) as raised:
        ingest.run({"photos": folder}, ingest.IngestSettings(), tmp_path / "out", Report())
    assert "0.png: it is a 360-degree panorama (equirectangular)" in raised.value.given


def test_a_panorama_among_photographs_is_left_out_by_name(tmp_path: Path) -> None:
    folder = tmp_path / "photos"
    folder.mkdir()
    for number in range(3):
        Image.fromarray(sphere(number)[:, :300]).save(folder / f"{number}.png")
    Image.fromarray(sphere(7)).save(folder / "round.png")
    report = Report()
    capture = ingest.run({"photos": folder}, ingest.IngestSettings(), tmp_path / "out", report)
    assert [photo.name for photo in capture.photos] == ["0.png", "1.png", "2.png"]
    (message,) = [text for code, text in report.warnings if code == "ingest-left-out"]
    assert "round.png is left out: it is a 360-degree panorama (equirectangular)" in message
    assert "Cut it into perspective pictures" in message
