"""From a folder of photographs to a capture."""

from __future__ import annotations

import errno
import json
import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pillow_heif
import pytest
from PIL import Image, ImageCms

from stages.base.errors import Family, Interrupted, SplatError
from stages.base.stage import Report
from stages.ingest import stage as ingest
from stages.ingest.settings import IngestSettings
from stages.run.digests import record_files
from stages.scene import Capture
from stages.scene.pictures import load_image
from tests.ingest.made_files import (
    exif,
    folder_of,
    save,
    textured,
)


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    """Three plain photographs; tests add a fourth."""
    return folder_of(tmp_path / "photos")


def ingested(
    photos: Path, out: Path | None = None, max_side: int = 1600
) -> tuple[Capture, dict[str, str], Report]:
    """The capture, its warnings by code (joined), and the report."""
    report = Report()
    folder = out or photos.parent / "out"
    capture = ingest.run({"photos": photos}, IngestSettings(max_side), folder, report)
    warnings: dict[str, str] = {}
    for code, message in report.warnings:
        warnings[code] = warnings.get(code, "") + message
    return capture, warnings, report


def picture(capture: Capture, name: str) -> np.ndarray:
    """[H, W, 3] the normalised picture of the photograph called `name`, 0..255."""
    (photo,) = [photo for photo in capture.photos if photo.name == name]
    return 255 * load_image(capture.folder / photo.image, photo.width, photo.height)


def test_an_upright_srgb_jpeg_that_is_small_enough_keeps_its_bytes(photos: Path) -> None:
    capture, _, _ = ingested(photos)
    for photo in capture.photos:
        assert (capture.folder / photo.image).read_bytes() == (photos / photo.name).read_bytes()


def test_the_users_folder_is_only_read(photos: Path) -> None:
    before = record_files(photos)
    ingested(photos)
    assert record_files(photos) == before


def test_a_folder_that_cannot_be_written_to_is_fine(photos: Path) -> None:
    photos.chmod(0o500)
    capture, _, _ = ingested(photos)
    assert len(capture.photos) == 3


def test_a_photograph_that_may_not_be_read_is_left_out_and_named(
    photos: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copy(next(photos.glob("*.jpg")), photos / "locked.jpg")
    read = Path.read_bytes

    def refusing(self: Path) -> bytes:
        if self.name == "locked.jpg":
            raise PermissionError(errno.EACCES, "Permission denied", str(self))
        return read(self)

    monkeypatch.setattr(Path, "read_bytes", refusing)
    capture, warnings, _ = ingested(photos)
    assert len(capture.photos) == 3
    assert "locked.jpg is left out" in warnings["ingest-left-out"]
    assert "Change its permissions" in warnings["ingest-left-out"]


def test_load_returns_what_run_returned(photos: Path) -> None:
    capture, _, _ = ingested(photos)
    assert ingest.load(capture.folder) == capture


def test_the_same_photographs_give_the_same_bytes_over_leftovers_too(photos: Path) -> None:
    save(photos / "big.webp", textured(7, 200, 150), quality=90)
    save(photos / "p.tif", textured(8))
    first, _, _ = ingested(photos, photos.parent / "a", 100)
    shutil.copytree(photos.parent / "a", photos.parent / "b")
    (photos.parent / "b" / "photos" / "p.png").write_bytes(b"half a pict")
    (photos.parent / "b" / "capture.json").unlink()
    second, _, _ = ingested(photos, photos.parent / "b", 100)
    digests = [
        {name: record.sha256 for name, record in record_files(capture.folder).items()}
        for capture in (first, second)
    ]
    assert digests[0] == digests[1]


@pytest.mark.parametrize("suffix", ["jpg", "png", "tif", "webp", "heic", "bmp", "JPEG"])
def test_each_format_is_read_and_scaled_to_the_longer_side(photos: Path, suffix: str) -> None:
    pixels = textured(9, 240, 160)
    if suffix == "heic":
        pillow_heif.register_heif_opener()
    options = {} if suffix in ("bmp", "tif", "png") else {"quality": 95}
    save(photos / f"x.{suffix}", pixels, **options)
    capture, warnings, _ = ingested(photos, max_side=120)
    shown = picture(capture, f"x.{suffix}")
    assert shown.shape == (80, 120, 3)
    expected = cv2.resize(pixels, (120, 80), interpolation=cv2.INTER_AREA).astype(float)
    assert np.abs(shown - expected).mean() < 5
    assert "ingest-left-out" not in warnings


@pytest.mark.parametrize("suffix", ["jpg", "png", "tif", "webp"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_orientation_is_applied_to_the_pixels_once(
    photos: Path, orientation: int, suffix: str
) -> None:
    upright = np.zeros((64, 96, 3), np.uint8)
    upright[:32, :48] = (250, 20, 20)  # top left red, bottom right blue: fixes all eight
    upright[32:, 48:] = (20, 20, 250)
    upright[:20, 70:] = (20, 250, 20)
    undo: dict[int, Callable[[np.ndarray], np.ndarray]] = {
        1: lambda a: a, 2: lambda a: a[:, ::-1], 3: lambda a: a[::-1, ::-1],
        4: lambda a: a[::-1], 5: lambda a: a.swapaxes(0, 1), 6: lambda a: np.rot90(a, 1),
        7: lambda a: a[::-1, ::-1].swapaxes(0, 1), 8: lambda a: np.rot90(a, -1),
    }  # fmt: skip
    stored = np.ascontiguousarray(undo[orientation](upright))
    coding: dict[str, dict[str, Any]] = {
        "jpg": {"quality": 95, "subsampling": 0}, "webp": {"lossless": True},
    }  # fmt: skip
    name = f"x.{suffix}"
    save(photos / name, stored, exif=exif(orientation=orientation), **coding.get(suffix, {}))
    capture, _, _ = ingested(photos)
    assert np.abs(picture(capture, name) - upright).mean() < 3
    if suffix != "tif":  # Pillow writes no focal length into a TIFF
        assert capture.photos[-1].focal_px == pytest.approx(96.0)


def test_a_heic_is_turned_once(photos: Path) -> None:
    pillow_heif.register_heif_opener()
    save(photos / "x.heic", textured(3, 96, 64), exif=exif(orientation=6).tobytes(), quality=95)
    capture, _, _ = ingested(photos)
    expected = np.rot90(textured(3, 96, 64), -1)
    assert np.abs(picture(capture, "x.heic") - expected).mean() < 6


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("suffix", ["png", "tif"])
def test_sixteen_bits_become_eight_of_the_same_brightness(
    photos: Path, suffix: str, channels: int
) -> None:
    pixels = textured(4)
    deep = pixels.astype(np.uint16) * 257
    stored = deep if channels == 3 else deep[..., 0]
    assert cv2.imwrite(str(photos / f"x.{suffix}"), stored)
    capture, _, _ = ingested(photos)
    expected = pixels[..., ::-1] if channels == 3 else pixels[..., :1]
    assert np.abs(picture(capture, f"x.{suffix}") - expected).max() <= 1


def test_grey_and_palette_pictures_become_rgb(photos: Path) -> None:
    grey = textured(5)[..., 0]
    save(photos / "grey.png", grey)
    Image.fromarray(textured(6)).convert("P").save(photos / "palette.png")
    capture, _, _ = ingested(photos)
    assert np.abs(picture(capture, "grey.png") - grey[..., None]).max() == 0
    assert np.abs(picture(capture, "palette.png") - textured(6)).mean() < 30


def test_what_is_transparent_is_empty_before_black_and_said(photos: Path) -> None:
    layered = np.dstack([textured(5), np.full((64, 96), 255, np.uint8)])
    save(photos / "opaque.png", layered)
    layered[:10, :, 3] = 0
    save(photos / "cut out.png", layered)
    capture, warnings, _ = ingested(photos)
    shown = picture(capture, "cut out.png")
    assert shown[:10].max() == 0
    np.testing.assert_array_equal(shown[10:].round(), textured(5)[10:])
    assert "cut out.png" in warnings["ingest-transparency"]
    assert "opaque.png" not in warnings["ingest-transparency"]


def test_a_profile_with_other_primaries_is_converted(photos: Path) -> None:
    """A profile that swaps red and green, made here: what it calls red is green to the eye."""
    profile = bytearray(ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes())
    for index in range(int.from_bytes(profile[128:132], "big")):
        entry = 132 + 12 * index
        name = bytes(profile[entry : entry + 4])
        if name in (b"rXYZ", b"gXYZ"):
            profile[entry : entry + 4] = b"gXYZ" if name == b"rXYZ" else b"rXYZ"
    swapped = bytes(profile)
    save(photos / "x.png", np.full((64, 96, 3), (200, 100, 50), np.uint8), icc_profile=swapped)
    capture, _, _ = ingested(photos)
    np.testing.assert_allclose(picture(capture, "x.png")[30, 40], (100, 200, 50), atol=1.01)


def test_a_jpeg_that_names_the_srgb_profile_keeps_its_bytes(photos: Path) -> None:
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    save(photos / "x.jpg", textured(5), icc_profile=profile)
    capture, _, _ = ingested(photos)
    assert (capture.folder / "photos/x.jpg").read_bytes() == (photos / "x.jpg").read_bytes()


def grey_profile(gamma: float) -> bytes:
    """A profile of grey pictures (ICC.1:2022, 8.3.2), white as D50, with a power as its curve."""
    curve = b"curv" + bytes(4) + (1).to_bytes(4, "big") + round(gamma * 256).to_bytes(2, "big")
    white = (
        b"XYZ "
        + bytes(4)
        + b"".join(round(one * 65536).to_bytes(4, "big") for one in (0.9642, 1.0, 0.8249))
    )
    words = b"desc" + bytes(4) + (5).to_bytes(4, "big") + b"grey\0" + bytes(78)
    tags, table, body = {b"desc": words, b"wtpt": white, b"kTRC": curve}, b"", b""
    for name, data in tags.items():
        at = 128 + 4 + 12 * len(tags) + len(body)
        table += name + at.to_bytes(4, "big") + len(data).to_bytes(4, "big")
        body += data + bytes(-len(data) % 4)
    header = bytes(8) + b"\2\x40\0\0" + b"mntrGRAYXYZ " + bytes(12) + b"acsp" + bytes(28)
    header += white[8:] + bytes(48)
    whole = header + len(tags).to_bytes(4, "big") + table + body
    return len(whole).to_bytes(4, "big") + whole[4:]


@pytest.mark.parametrize("mode", ["L", "LA"])
def test_grey_pictures_are_converted_by_their_profile(photos: Path, mode: str) -> None:
    """Half of the samples' range is 0.5 of the light where the curve is linear: 188 in sRGB."""
    grey = Image.new(mode, (96, 64), 128 if mode == "L" else (128, 255))
    if mode == "LA":
        grey.putpixel((0, 0), (128, 0))
    grey.save(photos / "x.png", icc_profile=grey_profile(1.0))
    capture, warnings, _ = ingested(photos)
    np.testing.assert_allclose(picture(capture, "x.png")[30, 40], 188, atol=1.01)
    assert "ingest-colour-profile" not in warnings


def test_a_grey_picture_may_have_a_profile_of_rgb(photos: Path) -> None:
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    Image.new("L", (96, 64), 128).save(photos / "x.jpg", icc_profile=profile)
    capture, warnings, _ = ingested(photos)
    assert (capture.folder / "photos/x.jpg").read_bytes() == (photos / "x.jpg").read_bytes()
    assert "ingest-colour-profile" not in warnings


def test_a_damaged_profile_is_said_and_passed_over(photos: Path) -> None:
    save(photos / "x.png", textured(5), icc_profile=b"no profile at all")
    capture, warnings, _ = ingested(photos)
    np.testing.assert_array_equal(picture(capture, "x.png").round(), textured(5))
    assert "x.png" in warnings["ingest-colour-profile"]


def test_names_with_spaces_folders_and_accents_are_kept(photos: Path) -> None:
    save(photos / "day 1" / "été 雪.jpg", textured(4))
    capture, _, _ = ingested(photos)
    assert "day 1/été 雪.jpg" in [photo.name for photo in capture.photos]
    assert (capture.folder / "photos/day 1/été 雪.jpg").is_file()


def test_names_that_are_not_utf8_or_hold_control_characters_are_escaped(photos: Path) -> None:
    for number, name in enumerate((b"bad\xff.jpg", b"red\x1b[31m.jpg", b"two\nlines.jpg")):
        save(photos / "plain.jpg", textured(20 + number))
        os.rename(photos / "plain.jpg", os.fsencode(photos) + b"/" + name)
    capture, _, _ = ingested(photos)
    names = {photo.name for photo in capture.photos}
    assert {r"bad\xff.jpg", r"red\x1b[31m.jpg", r"two\nlines.jpg"} <= names
    assert ingest.load(capture.folder) == capture


def test_photographs_of_the_same_name_in_two_formats_stay_apart(photos: Path) -> None:
    save(photos / "IMG_1.webp", textured(8))
    save(photos / "img_1.tif", textured(9))
    save(photos / "img_1.png", textured(10))
    capture, _, _ = ingested(photos)
    images = [photo.image.lower() for photo in capture.photos]
    assert len(set(images)) == 6
    np.testing.assert_array_equal(picture(capture, "img_1.png").round(), textured(10))
    np.testing.assert_array_equal(picture(capture, "img_1.tif").round(), textured(9))


def test_hidden_files_and_other_files_are_passed_over(photos: Path) -> None:
    (photos / "._IMG_1.jpg").write_bytes(b"\0\5\26\7")
    (photos / ".thumbnails").mkdir()
    save(photos / ".thumbnails" / "a.jpg", textured(1))
    (photos / "notes.txt").write_text("shot in the evening")
    capture, warnings, report = ingested(photos)
    assert len(capture.photos) == 3
    assert report.metrics["files_ignored"] == 1
    assert set(warnings) == {"ingest-few-photographs", "ingest-small"}


def test_pictures_beside_the_frames_of_a_scan_are_named_except_its_thumbnail(photos: Path) -> None:
    for number, photograph in enumerate(sorted(photos.iterdir())):
        photograph.rename(photos / f"frame_0000{number}.jpg")
        (photos / f"frame_0000{number}.json").write_text("{}")
    save(photos / "textured_output.jpg", textured(1))
    capture, warnings, report = ingested(photos)
    assert len(capture.photos) == 3
    assert "textured_output.jpg" in warnings["ingest-beside-frames"]
    assert report.metrics["files_ignored"] == 3
    (photos / "textured_output.jpg").rename(photos / "thumb_00000.jpg")  # every scan has one
    capture, warnings, report = ingested(photos)
    assert len(capture.photos) == 3
    assert "ingest-beside-frames" not in warnings
    assert report.metrics["files_ignored"] == 4


@pytest.mark.parametrize("suffix", ["jpg", "png", "tif", "webp", "heic"])
@pytest.mark.parametrize("kept", [0.97, 0.5, 0.02])
def test_truncated_photographs_are_named_and_left_out(
    photos: Path, suffix: str, kept: float
) -> None:
    if suffix == "heic":
        pillow_heif.register_heif_opener()
    path = save(photos / f"x.{suffix}", textured(4, 400, 300))
    data = path.read_bytes()
    path.write_bytes(data[: int(kept * len(data))])
    capture, warnings, _ = ingested(photos)
    assert f"x.{suffix}" in warnings["ingest-left-out"]
    assert len(capture.photos) == 3
    assert not [file for file in capture.folder.rglob("*") if file.stem == "x"]


def test_a_truncated_jpeg_with_a_whole_thumbnail_is_found(photos: Path) -> None:
    small = save(photos.parent / "small.jpg", textured(1, 40, 30)).read_bytes()
    whole = save(photos / "x.jpg", textured(4, 400, 300)).read_bytes()
    comment = b"\xff\xfe" + (len(small) + 2).to_bytes(2, "big") + small
    (photos / "x.jpg").write_bytes(whole[:2] + comment + whole[2:-2000] + bytes(1998))
    _, warnings, _ = ingested(photos)
    assert "x.jpg is left out: the file is truncated" in warnings["ingest-left-out"]
    (photos / "x.jpg").write_bytes(whole[:2] + comment + whole[2:])
    assert "ingest-left-out" not in ingested(photos)[1]


@pytest.mark.parametrize(
    ("data", "why"),
    [
        (b"", "the file is empty"),
        (b"GIF89a" + bytes(50), "it is a GIF"),
        (b"<html>not found</html>", "it holds text"),
        (bytes(range(256)) * 9, "it is not a picture"),
    ],
)
def test_files_that_only_claim_to_be_photographs_are_left_out(
    photos: Path, data: bytes, why: str
) -> None:
    (photos / "x.jpg").write_bytes(data)
    capture, warnings, report = ingested(photos)
    assert f"x.jpg is left out: {why}" in warnings["ingest-left-out"]
    assert (len(capture.photos), report.metrics["left_out"]) == (3, 1)


def test_a_file_under_another_formats_name_is_read_by_its_content(photos: Path) -> None:
    save(photos / "x.jpg", textured(4), format="PNG")
    capture, _, _ = ingested(photos)
    with Image.open(capture.folder / "photos/x.jpg") as image:
        assert image.format == "JPEG"
    assert np.abs(picture(capture, "x.jpg") - textured(4)).mean() < 3


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="the system has no pipes of this kind")
def test_links_and_pipes_among_the_photographs_are_named_and_counted(photos: Path) -> None:
    folder_of(photos.parent / "more")
    (photos / "broken.jpg").symlink_to(photos / "nothing.jpg")
    (photos / "loop.jpg").symlink_to(photos / "loop.jpg")
    (photos / "day 2").symlink_to(photos.parent / "more", target_is_directory=True)
    os.mkfifo(photos / "pipe.jpg")
    capture, warnings, report = ingested(photos)
    assert (len(capture.photos), report.metrics["left_out"]) == (3, 4)
    for name in ("broken.jpg", "loop.jpg", "day 2", "pipe.jpg"):
        assert name in warnings["ingest-left-out"]


def test_a_decompression_bomb_is_left_out(photos: Path) -> None:
    Image.new("1", (20000, 20000)).save(photos / "x.png")
    _, warnings, _ = ingested(photos)
    assert "x.png is left out: 20000 x 20000 is more than 200" in warnings["ingest-left-out"]
    assert "Scale it down" in warnings["ingest-left-out"]


def test_what_is_not_read_is_named_with_advice(photos: Path) -> None:
    for name in ("clip.MOV", "a.nef", "IMG_1.DNG", "b.psd", "c.gif"):
        (photos / name).write_bytes(b"data")
    _, warnings, _ = ingested(photos)
    assert "c.gif is left out" in warnings["ingest-left-out"]
    assert "clip.MOV is left out" in warnings["ingest-left-out"]
    assert "a.nef" in warnings["ingest-raw-not-read"]
    assert "IMG_1.DNG" not in warnings["ingest-raw-not-read"], "the JPEG beside it is used"
    assert "b.psd" in warnings["ingest-format-not-read"]


def error_of(photos: Path) -> SplatError:
    with pytest.raises(SplatError) as caught:
        ingested(photos, photos.parent / "out")
    assert caught.value.hint
    assert not (photos.parent / "out" / "capture.json").exists()
    return caught.value


def test_bad_folders_each_get_their_own_message(tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    assert error_of(photos).code == "ingest-empty-folder"
    (photos / "a.txt").write_text("a")
    text_only = error_of(photos)
    assert (text_only.code, text_only.family) == ("ingest-no-photographs", Family.INPUT)
    assert "(1 other file)" in text_only.given
    (photos / "clip.mp4").write_bytes(b"a")
    assert "clip.mp4" in error_of(photos).given
    single = save(tmp_path / "one.jpg", textured(1))
    assert str(tmp_path) in error_of(single).hint
    assert error_of(single).code == "ingest-not-a-folder"


@pytest.mark.parametrize("usable", [0, 1, 2])
def test_fewer_than_three_usable_photographs_are_an_error(tmp_path: Path, usable: int) -> None:
    photos = folder_of(tmp_path / "photos", usable)
    photos.mkdir(exist_ok=True)
    (photos / "broken.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    error = error_of(photos)
    assert error.code == "ingest-too-few-photographs"
    assert f"{usable} usable" in error.given
    assert "broken.png" in error.given
    assert error.hint.startswith("Copy it" if usable == 2 else "Take photographs")


def test_a_full_disk_is_an_error_and_leaves_no_half_picture(
    photos: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(self: Path, data: bytes) -> int:
        with self.open("wb") as file:
            file.write(data[:10])
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(SplatError) as caught:
        ingested(photos)
    assert (caught.value.code, caught.value.family) == ("disk-full", Family.RESOURCES)
    assert not [path for path in (photos.parent / "out").rglob("*") if path.is_file()]


def test_stopping_is_heeded_between_photographs(photos: Path) -> None:
    report = Report()
    report.stop_requested.set()
    with pytest.raises(Interrupted):
        ingest.run({"photos": photos}, IngestSettings(), photos.parent / "out", report)


def test_progress_counts_every_photograph(photos: Path) -> None:
    ticks: list[tuple[int, int, str]] = []
    report = Report(listener=lambda label, done, total, _: ticks.append((done, total, label)))
    ingest.run({"photos": photos}, IngestSettings(), photos.parent / "out", report)
    assert ticks[1:] == [(1, 3, "IMG_1.jpg"), (2, 3, "IMG_2.jpg"), (3, 3, "IMG_3.jpg")]


def capture_json(photos: Path) -> tuple[Path, dict]:
    capture, _, _ = ingested(photos)
    path = capture.folder / "capture.json"
    return path, json.loads(path.read_text(encoding="utf-8"))


@pytest.mark.parametrize(
    "change",
    [
        {"image": "../../etc/passwd"}, {"image": "/etc/passwd"}, {"image": "photos/gone.jpg"},
        {"image": None}, {"extra": 1}, {"gps": [1.0]},
    ],
)  # fmt: skip
def test_a_capture_edited_by_hand_is_refused(photos: Path, change: dict) -> None:
    path, data = capture_json(photos)
    data["photos"][0].update(change)
    path.write_text(json.dumps(data), encoding="utf-8")
    with pytest.raises(SplatError) as caught:
        ingest.load(path.parent)
    assert (caught.value.code, caught.value.family) == (
        "ingest-capture-damaged",
        Family.RUN_FOLDER,
    )


@pytest.mark.parametrize("text", ["", "{", "[]", "{}", '{"schema": 1, "photos": []}', "\xff"])
def test_a_capture_file_of_garbage_is_refused(photos: Path, text: str) -> None:
    path, _ = capture_json(photos)
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(SplatError, match=r"capture\.json"):
        ingest.load(path.parent)


def test_the_sample_capture_gives_no_warning(tmp_path: Path) -> None:
    photos = Path(__file__).parents[2] / "sample_captures" / "still_life" / "images"
    capture, warnings, report = ingested(photos, tmp_path / "out")
    assert warnings == {}
    assert report.metrics["photographs"] == report.metrics["with_focal_length"] == 24
    assert report.metrics["cameras"] == 1
    assert {photo.focal_px for photo in capture.photos} == {604.444}  # 640 x 34 mm / 36 mm


def test_settings_name_their_unit() -> None:
    settings = replace(IngestSettings(), max_side=100)
    assert settings.max_side == 100
    assert "px" in IngestSettings.__dataclass_fields__["max_side"].metadata["help"]
