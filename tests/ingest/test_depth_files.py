"""Measured depth beside photographs: which map belongs to which, and what it says in metres."""

from __future__ import annotations

import io
import json
from contextlib import suppress
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from PIL import Image

from stages.base.errors import Family, SplatError
from stages.base.stage import Report
from stages.cameras.lens import Lens
from stages.ingest import stage as ingest
from stages.ingest.decode import Decoded, Unusable, readers_set_up
from stages.ingest.depth_files import read_depth
from stages.ingest.exif import Exif
from stages.ingest.find import find
from stages.ingest.settings import IngestSettings
from stages.ingest.sources import DepthFile
from stages.run.pipeline import Pipeline
from stages.scene import Camera, Capture
from stages.scene.pictures import load_depth
from stages.sfm.undistorted_images import PosedPhoto, depth_file, write_undistorted_images
from tests.ingest.made_files import exif, folder_of, save, textured

WIDE, HIGH = 48, 32  # of the maps; the photographs have 96 x 64
METRES = np.linspace(1.0, 2.0, WIDE, dtype=np.float32)[None] * np.ones((HIGH, 1), np.float32)
METRES = np.round(METRES, 3)
METRES[4, 5] = 0.0
MILLIMETRES = np.round(1000 * METRES).astype(np.uint16)


def write_exr(path: Path, values: np.ndarray, half: bool = False) -> None:
    """Grey [H, W] or colour [H, W, 3] as floats, of 16 bits if `half`."""
    kind = "grayf32le" if values.ndim == 2 else "gbrpf32le"
    made = io.BytesIO()
    with av.open(made, "w", format="image2pipe") as out:
        options = {"format": "half" if half else "float"}
        stream = out.add_stream("exr", rate=1, options=options)
        stream.width, stream.height, stream.pix_fmt = values.shape[1], values.shape[0], kind
        frame = av.VideoFrame.from_ndarray(values, format=kind)
        frame.pts = 0
        for packet in (*stream.encode(frame), *stream.encode(None)):
            out.mux(packet)
    path.write_bytes(made.getvalue())


def write_map(path: Path, metres: np.ndarray = METRES) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".npy":
        np.save(path, metres)
    elif path.suffix == ".exr":
        write_exr(path, metres)
    elif path.suffix == ".png":
        save(path, np.round(1000 * metres).astype(np.uint16))
    else:
        save(path, metres)  # TIFF of floats


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    return folder_of(tmp_path / "photos")


def taken(photos: Path, depth: Path | None = None) -> tuple[Capture, dict[str, str]]:
    report = Report()
    settings = IngestSettings(depth=depth)
    capture = ingest.run({"photos": photos}, settings, photos.parent / "out", report)
    return capture, dict(report.warnings)


def maps_of(capture: Capture) -> list[Any]:
    """The map of each photograph; None for one without."""
    return [load_depth(capture.folder / p.depth) if p.depth else None for p in capture.photos]


@pytest.mark.parametrize("form", ["IMG_{}.png", "IMG_{}.jpg.tif", "IMG_{}_depth.exr", "IMG_{}.npy"])
def test_files_of_every_kind_give_the_same_metres(photos: Path, form: str) -> None:
    for number in (1, 2):
        write_map(photos.parent / "sensor" / form.format(number))
    capture, warnings = taken(photos, photos.parent / "sensor")
    one, two, three = maps_of(capture)
    np.testing.assert_allclose(one, METRES, atol=1e-6)
    assert one is not None
    assert two is not None
    assert three is None
    assert one[4, 5] == 0
    assert "ingest-depth-left-out" not in warnings


def test_the_red_channel_of_a_colour_exr_is_the_depth(photos: Path) -> None:
    (photos / "depth").mkdir()
    write_exr(photos / "depth" / "IMG_1.exr", np.stack([METRES, 2 * METRES, 3 * METRES], -1))
    np.testing.assert_array_equal(maps_of(taken(photos)[0])[0], METRES)


@pytest.mark.parametrize("channel", [b"Y", b"R", b"Z"])
@pytest.mark.parametrize("half", [False, True])
def test_the_only_channel_of_an_exr_is_the_depth(photos: Path, channel: bytes, half: bool) -> None:
    """Record3D writes one channel, called R, of 16 bits."""
    path = photos / "depth" / "IMG_1.exr"
    path.parent.mkdir()
    write_exr(path, METRES, half)
    data = path.read_bytes()
    assert data.count(b"\x13\0\0\0Y\0") == 1
    path.write_bytes(data.replace(b"\x13\0\0\0Y\0", b"\x13\0\0\0" + channel + b"\0"))
    np.testing.assert_allclose(maps_of(taken(photos)[0])[0], METRES, rtol=1e-3 if half else 0)


def test_the_red_channel_of_an_exr_of_16_bits_is_the_depth(photos: Path) -> None:
    (photos / "depth").mkdir()
    write_exr(photos / "depth" / "IMG_1.exr", np.stack([METRES, 2 * METRES, 3 * METRES], -1), True)
    np.testing.assert_allclose(maps_of(taken(photos)[0])[0], METRES, rtol=1e-3)


def test_an_exr_that_ffmpeg_does_not_know_is_left_out(photos: Path) -> None:
    path = photos / "depth" / "IMG_1.exr"
    path.parent.mkdir()
    write_exr(path, METRES)
    path.write_bytes(path.read_bytes().replace(b"Y\0", b"\0\0", 1))
    assert "IMG_1.exr does not decode" in taken(photos)[1]["ingest-depth-left-out"]


def test_what_is_not_a_positive_number_was_not_measured(photos: Path) -> None:
    holes = METRES.copy()
    holes[0, :4] = np.nan, np.inf, -np.inf, -1.0
    write_map(photos / "depth" / "IMG_1.npy", holes)
    (found, *_) = maps_of(taken(photos)[0])
    assert found is not None
    assert not found[0, :4].any()
    np.testing.assert_array_equal(found[1:], METRES[1:])


def test_the_largest_number_of_16_bits_was_not_measured(photos: Path) -> None:
    stored = MILLIMETRES.copy()
    stored[0, :4] = 65535
    (photos / "depth").mkdir()
    Image.fromarray(stored).save(photos / "depth" / "IMG_1.png")
    (found, *_) = maps_of(taken(photos)[0])
    assert found is not None
    assert not found[0, :4].any()
    np.testing.assert_allclose(found[1:], METRES[1:], atol=1e-6)


@pytest.mark.parametrize("where", ["photos/depth", "photos/depths", "depth"])
def test_a_folder_called_depth_in_or_beside_the_photographs_is_used(
    photos: Path, where: str
) -> None:
    write_map(photos.parent / where / "IMG_2.png")
    write_map(photos.parent / where / "IMG_99.png")
    capture, warnings = taken(photos)
    assert [photo.name for photo in capture.photos] == ["IMG_1.jpg", "IMG_2.jpg", "IMG_3.jpg"]
    assert [bool(photo.depth) for photo in capture.photos] == [False, True, False]
    assert "IMG_99.png" in warnings["ingest-depth-unused"]


def test_photographs_of_a_folder_called_depth_are_photographs(photos: Path) -> None:
    folder_of(photos / "depth", 2)
    assert len(find(photos).sources) == 5


@pytest.mark.parametrize(
    "form", ["IMG_{}_depth.png", "IMG_{}.jpg.png", "IMG_{}.png", "IMG_{}.npy", "IMG_{}_depth.exr"]
)
def test_the_folder_of_maps_may_be_that_of_the_photographs(photos: Path, form: str) -> None:
    for number in (1, 2, 3):
        write_map(photos / form.format(number))
        save(photos / f"IMG_{number}_mask.png", np.eye(64, 96, dtype=np.uint8) * 255)
    capture, warnings = taken(photos, photos)
    assert [photo.name for photo in capture.photos] == ["IMG_1.jpg", "IMG_2.jpg", "IMG_3.jpg"]
    assert all(photo.mask for photo in capture.photos)
    for found in maps_of(capture):
        np.testing.assert_allclose(found, METRES, atol=1e-6)
    assert not [code for code in warnings if code.startswith("ingest-depth")]


@pytest.mark.parametrize("suffix", ["png", "tif"])
def test_maps_beside_photographs_are_no_photographs(photos: Path, suffix: str) -> None:
    for number in (1, 2, 3):
        write_map(photos / f"IMG_{number}_depth.{suffix}")
    capture, warnings = taken(photos)
    assert [photo.name for photo in capture.photos] == ["IMG_1.jpg", "IMG_2.jpg", "IMG_3.jpg"]
    assert not any(photo.depth for photo in capture.photos)
    assert f"IMG_2_depth.{suffix}" in warnings["ingest-depth-beside"]
    assert "--depth" in warnings["ingest-depth-beside"]


def test_masks_of_colmap_s_names_are_no_maps(photos: Path) -> None:
    for number in (1, 2, 3):
        write_map(photos / f"IMG_{number}_depth.png")
        save(photos / f"IMG_{number}.jpg.png", np.eye(64, 96, dtype=np.uint8) * 255)
    capture, _ = taken(photos, photos)
    assert [bool(p.mask and p.depth) for p in capture.photos] == [True, True, True]


def test_a_picture_of_8_bits_is_a_photograph_whatever_its_name(photos: Path) -> None:
    save(photos / "IMG_1_depth.png", textured(7))
    assert len(find(photos).sources) == 4


def test_polycam_s_confidence_leaves_the_sure_pixels(photos: Path) -> None:
    write_map(photos.parent / "depth" / "IMG_1.png")
    sure = np.full((HIGH, WIDE), 255, np.uint8)
    sure[:10], sure[10:20] = 0, 127
    save(photos.parent / "confidence" / "IMG_1.png", sure)
    (found, *_) = maps_of(taken(photos)[0])
    assert found is not None
    assert not found[:20].any()
    np.testing.assert_allclose(found[20:], METRES[20:], atol=1e-6)


def test_3d_scanner_app_s_maps_lie_among_its_photographs(tmp_path: Path) -> None:
    for number in range(3):
        save(tmp_path / "scan" / f"frame_0000{number}.jpg", textured(number))
        save(tmp_path / "scan" / f"depth_0000{number}.png", MILLIMETRES)
        save(tmp_path / "scan" / f"conf_0000{number}.png", np.full((HIGH, WIDE), 2, np.uint8))
    for number in range(4):
        (tmp_path / "scan" / f"frame_0000{number}.json").write_text("{}")
    save(tmp_path / "scan" / "depth_00003.png", MILLIMETRES)  # a frame without a picture
    capture, warnings = taken(tmp_path / "scan")
    assert [photo.name for photo in capture.photos] == [f"frame_0000{i}.jpg" for i in range(3)]
    assert "ingest-depth-unused" not in warnings
    for found in maps_of(capture):
        np.testing.assert_allclose(found, METRES, atol=1e-6)


def transforms(photos: Path, **more: object) -> Path:
    frames = [
        {"file_path": f"photos/IMG_{i}.jpg", "depth_file_path": f"z/{i}.png"} for i in range(1, 4)
    ]
    path = photos.parent / "transforms.json"
    path.write_text(json.dumps({"frames": frames, **more}))
    return path


def test_a_transforms_json_names_maps_and_their_unit(photos: Path) -> None:
    for number in range(1, 4):
        save(photos.parent / "z" / f"{number}.png", MILLIMETRES)
    for unit, factor in (({}, 1.0), ({"depth_unit_scale_factor": 0.0002}, 0.2)):
        for found in maps_of(taken(photos, transforms(photos, **unit))[0]):
            np.testing.assert_allclose(found, factor * METRES, rtol=1e-6)


@pytest.mark.parametrize("unit", [0, -1, "mm", float("nan")])
def test_an_unknown_unit_is_refused(photos: Path, unit: object) -> None:
    with pytest.raises(SplatError, match=r"transforms\.json") as refused:
        taken(photos, transforms(photos, depth_unit_scale_factor=unit))
    assert refused.value.code == "cameras-unreadable"
    assert refused.value.family == Family.INPUT


def test_a_map_lies_as_the_stored_file_or_upright(tmp_path: Path) -> None:
    photos = folder_of(tmp_path / "photos")
    turned = exif(orientation=6)  # to be turned by 90 degrees clockwise
    for number in (1, 2):
        save(photos / f"IMG_{number}.jpg", textured(number), exif=turned)
    write_map(photos / "depth" / "IMG_1.npy")
    write_map(photos / "depth" / "IMG_2.npy", np.rot90(METRES, -1))
    one, two, _ = maps_of(taken(photos)[0])
    np.testing.assert_array_equal(one, np.rot90(METRES, -1))
    np.testing.assert_array_equal(two, np.rot90(METRES, -1))


def spoil(folder: Path, how: str) -> None:
    path = folder / "IMG_1.npy"
    write_map(path)
    if how == "aspect":
        write_map(path, METRES[:20])
    elif how == "eight bits":
        path.unlink()
        save(folder / "IMG_1.png", np.full((HIGH, WIDE), 99, np.uint8))
    elif how == "colour":
        write_map(path, np.stack([METRES] * 3, -1))
    elif how == "nothing":
        write_map(path, np.full_like(METRES, np.nan))
    elif how == "two":
        write_map(folder / "IMG_1_depth.exr")
    elif how == "cut short":
        path.write_bytes(path.read_bytes()[:200])
    elif how == "no picture":
        path.unlink()
        (folder / "IMG_1.exr").write_bytes(b"no picture at all")


def test_a_transforms_json_names_maps_of_photographs_of_one_name_in_two_folders(
    photos: Path,
) -> None:
    names = [f"{camera}/IMG_{number}.jpg" for camera in ("left", "right") for number in (1, 2)]
    for number, name in enumerate(names):
        (photos / name).parent.mkdir(exist_ok=True)
        save(photos / name, textured(number))
        write_map(photos.parent / "z" / f"{number}.npy")
    frames = [
        {"file_path": f"photos/{name}", "depth_file_path": f"z/{number}.npy"}
        for number, name in enumerate(names)
    ]
    path = photos.parent / "transforms.json"
    path.write_text(json.dumps({"frames": frames}))
    found = find(photos, None, path).depths
    assert {name: file.path.name for name, file in found.items()} == {
        name: f"{number}.npy" for number, name in enumerate(names)
    }


@pytest.mark.parametrize(
    "how", ["aspect", "eight bits", "colour", "nothing", "two", "cut short", "no picture"]
)
def test_a_map_that_cannot_be_used_is_left_out_by_name_and_its_photograph_stays(
    photos: Path, how: str
) -> None:
    spoil(photos / "depth", how)
    write_map(photos / "depth" / "IMG_2.png")
    capture, warnings = taken(photos)
    assert [bool(photo.depth) for photo in capture.photos] == [False, True, False]
    assert warnings["ingest-depth-left-out"].startswith("IMG_1.jpg is used without its depth map: ")
    assert len(capture.photos) == 3


@pytest.mark.parametrize("suffix", ["png", "tif", "exr", "npy"])
def test_a_damaged_map_is_unusable_or_holds_numbers(tmp_path: Path, suffix: str) -> None:
    path, random = tmp_path / f"a.{suffix}", np.random.default_rng(3)
    write_map(path)
    whole = path.read_bytes()
    photograph = Decoded(np.zeros((64, 96, 3), np.uint8), (96, 64), Exif())
    with readers_set_up():
        for _ in range(100):
            content = bytearray(whole[: random.integers(len(whole) // 2, len(whole) + 1)])
            for at in random.integers(0, min(len(content), 500), 3):
                content[at] = random.integers(256)
            path.write_bytes(content)
            with suppress(Unusable):
                found = read_depth(DepthFile(path), photograph)
                assert np.isfinite(found).all()
                assert found.min() >= 0


def test_a_chosen_folder_without_maps_of_the_photographs_is_refused(photos: Path) -> None:
    write_map(photos.parent / "sensor" / "other.png")
    for chosen in (photos.parent / "sensor", photos.parent / "nowhere"):
        with pytest.raises(SplatError) as refused:
            taken(photos, chosen)
        assert refused.value.code == "depth-missing"
        assert refused.value.family == Family.INPUT


def test_without_depth_the_capture_says_nothing_of_it(photos: Path) -> None:
    capture, _ = taken(photos)
    assert "depth" not in (capture.folder / "capture.json").read_text()


def test_ingest_runs_again_if_and_only_if_a_map_or_its_confidence_changed(photos: Path) -> None:
    write_map(photos.parent / "depth" / "IMG_1.png")
    sure = photos.parent / "confidence" / "IMG_1.png"
    save(sure, np.full((HIGH, WIDE), 255, np.uint8))
    pipeline = Pipeline(photos.parent / "run", photos)
    pipeline.run({}, until="ingest")
    assert pipeline.load("ingest").photos[0].depth
    assert not pipeline.plan()[0].will_run
    save(sure, np.full((HIGH, WIDE), 127, np.uint8))
    assert "confidence/IMG_1.png changed" in pipeline.plan()[0].reason


def test_undistortion_moves_depth_to_where_the_lens_shows_it(photos: Path) -> None:
    """A floor: its depth depends on the row, through the lens and without it."""
    lens, camera = Lens(radial=(-0.25,)), Camera(96, 64, 80.0, 80.0, 48.0, 32.0, np.eye(4))
    rows, columns = np.mgrid[:HIGH, :WIDE] + 0.5
    seen = np.stack([(2 * columns - 48) / 80, (2 * rows - 32) / 80], -1)
    true = lens.undistort(seen.reshape(-1, 2)).reshape(seen.shape)
    floor = 1.0 / (1.0 + true[..., 1])  # z where y + z = 1
    write_map(photos / "depth" / "IMG_1.npy", floor.astype(np.float32))
    capture, _ = taken(photos)
    report = Report()
    posed = [PosedPhoto(capture.photos[0], camera, lens)]
    made = write_undistorted_images(posed, capture.folder, photos.parent, report)
    pinhole = made[0][0]
    depth = load_depth(photos.parent / depth_file(capture.photos[0]))
    scale = depth.shape[0] / pinhole.height
    v = ((np.arange(depth.shape[0]) + 0.5) / scale - pinhole.cy) / pinhole.fy
    half_a_pixel = 0.5 / 40  # of a nearest sample, in the same units
    steepest = (1.0 / (1.0 + v.min())) ** 2
    assert abs(depth.shape[1] / depth.shape[0] - pinhole.width / pinhole.height) < 0.05
    assert np.abs(depth - (1.0 / (1.0 + v))[:, None]).max() < 2 * half_a_pixel * steepest
