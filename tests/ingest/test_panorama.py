"""360-degree pictures are recognised, and ordinary ones twice as wide as high are not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from stages.base.errors import SplatError
from stages.base.stage import Report
from stages.ingest import stage as ingest
from stages.ingest.panorama import SPHERE, panorama, projection_of
from stages.ingest.settings import IngestSettings
from tests.ingest.spheres import sphere, two_fisheyes
from tests.sfm.checks.bad_captures import SAMPLE


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
def test_a_rough_seam_and_poles_that_are_no_single_point_leave_it_a_panorama(seed: int) -> None:
    """As stitching leaves them: brighter on one side, and something else filled in at the poles."""
    gain = np.linspace(0.97, 1.03, 512)[None, :, None]
    pixels = np.clip(128 + gain * (sphere(seed) - 128.0), 0, 255)
    waves = 0.4 * np.sqrt(2) * np.median(pixels.mean(axis=2).std(axis=1))
    pixels[[0, 1, -2, -1]] += waves * np.sin(np.arange(512) / 20)[None, :, None]
    stitched = np.clip(pixels, 0, 255).astype(np.uint8)
    assert panorama(stitched, size(stitched), "") == SPHERE


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


@pytest.mark.parametrize("seed", range(5))
def test_upright_pictures_are_none_however_their_edges_look(seed: int) -> None:
    """A phone's of an object before a wall that gets brighter upwards."""
    rng = np.random.default_rng(seed)
    wall = np.tile(np.linspace(200, 90, 1024)[:, None, None], (1, 512, 3))
    wall[100:900, 100:400] = rng.integers(0, 256, (40, 15, 3)).repeat(20, 0).repeat(20, 1)
    upright = np.clip(wall + rng.normal(0, 2, wall.shape), 0, 255).astype(np.uint8)
    assert panorama(upright, size(upright), "") == ""
    assert panorama(upright, (1024, 512), "") == ""  # turned by EXIF


def test_a_wall_without_contrast_is_none() -> None:
    pixels = np.full((256, 512, 3), 180, np.uint8)
    assert panorama(pixels, size(pixels), "") == ""


def test_two_fisheyes_side_by_side_are_named() -> None:
    pixels = two_fisheyes(3)
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
    black = np.zeros((60, 120, 3), np.uint8)
    assert panorama(black, (120, 60), "equirectangular") == SPHERE
    assert projection_of(b"<GPano:Nothing/>") == ""


def test_panoramas_of_another_ratio_and_parts_of_one_are_named() -> None:
    black = np.zeros((90, 120, 3), np.uint8)
    found = panorama(black, (120, 90), "equirectangular")
    assert found == "a panorama (equirectangular, 120 x 90, as its metadata say)"
    part = (
        b'GPano:ProjectionType="equirectangular" GPano:FullPanoWidthPixels="8000" '
        b'GPano:CroppedAreaImageWidthPixels="4000"'
    )
    assert projection_of(part) == "partial equirectangular"
    assert projection_of(part.replace(b"4000", b"8000")) == "equirectangular"
    assert "(partial equirectangular" in panorama(black[:60], (120, 60), projection_of(part))


def test_two_fisheyes_among_photographs_are_left_out_by_name(tmp_path: Path) -> None:
    folder = tmp_path / "photos"
    folder.mkdir()
    for number in range(3):
        Image.fromarray(sphere(number)[:, :300]).save(folder / f"{number}.png")
    Image.fromarray(two_fisheyes(3)).save(folder / "two.png")
    report = Report()
    capture = ingest.run({"photos": folder}, IngestSettings(), tmp_path / "out", report)
    assert [photo.name for photo in capture.photos] == ["0.png", "1.png", "2.png"]
    (message,) = [text for code, text in report.warnings if code == "ingest-left-out"]
    assert "two.png is left out: it is a pair of fisheye pictures side by side" in message
    assert "Stitch it" in message


PART = (
    b'<rdf:Description GPano:ProjectionType="equirectangular" GPano:FullPanoWidthPixels="1024" '
    b'GPano:CroppedAreaImageWidthPixels="512"/>'
)


@pytest.mark.parametrize(("part", "advice"), [(False, "Stitch it in"), (True, "Export the whole")])
def test_panoramas_that_cannot_be_cut_are_an_error_that_says_what_to_do(
    tmp_path: Path, part: bool, advice: str
) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    for number in range(3):
        pixels = sphere(number)[:, :300] if part else two_fisheyes(number)
        Image.fromarray(pixels).save(photos / f"{number}.jpg", xmp=PART if part else b"")
    with pytest.raises(SplatError) as caught:
        ingest.run({"photos": photos}, IngestSettings(), tmp_path / "out", Report())
    assert caught.value.code == "ingest-too-few-photographs"
    assert caught.value.hint.startswith(advice)
    assert "in small steps" not in caught.value.hint


@pytest.mark.parametrize(("ordinary", "faces"), [(3, False), (1, True)])
def test_pictures_that_look_like_panoramas_are_what_most_of_their_shape_are(
    tmp_path: Path, ordinary: int, faces: bool
) -> None:
    folder = tmp_path / "photos"
    folder.mkdir()
    for number in range(2):
        Image.fromarray(sphere(number)).save(folder / f"like{number}.png")
    for number, path in enumerate(sorted(SAMPLE.glob("*.jpg"))[:ordinary]):
        Image.fromarray(cropped(path)).save(folder / f"photo{number}.png")
    report = Report()
    capture = ingest.run({"photos": folder}, IngestSettings(), tmp_path / "out", report)
    assert report.metrics["photographs"] == 2 + ordinary
    assert report.metrics["panoramas"] == (2 if faces else 0)
    assert any(photo.face is not None for photo in capture.photos) == faces
    unclear = [text for code, text in report.warnings if code == "ingest-panorama-unclear"]
    assert bool(unclear) != faces
    assert all("like0.png, like1.png" in text for text in unclear)
