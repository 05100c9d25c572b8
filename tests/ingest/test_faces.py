"""Panoramas are cut into faces that show what lies in their directions."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from PIL import Image

from stages.base.errors import SplatError
from stages.base.stage import Report
from stages.ingest import capture_file
from stages.ingest import stage as ingest
from stages.ingest.decode import Decoded
from stages.ingest.exif import Exif
from stages.ingest.faces import DIRECTIONS, FIELD_DEG, WIDTHS, face_photos, face_rotation
from stages.ingest.masking import MaskedPhoto
from stages.ingest.settings import IngestSettings
from stages.scene import IGNORE, Camera, Capture, Photo, View, split_held_out
from stages.scene.rotations import matrices_of
from tests.ingest.films import film
from tests.ingest.spheres import sphere, two_fisheyes

WIDTH = 1024
COS, SIN = np.cos(np.radians(12.5)), np.sin(np.radians(12.5))


def directions(width: int = WIDTH) -> np.ndarray:
    """[W / 2, W, 3] the unit direction of each pixel of a panorama: x right, y down, z ahead."""
    y, x = np.mgrid[: width // 2, :width] + 0.5
    longitude, down = 2 * np.pi * (x / width - 0.5), np.pi * (2 * y / width - 0.5)
    return np.stack(
        [np.sin(longitude) * np.cos(down), np.sin(down), np.cos(longitude) * np.cos(down)], axis=-1
    )


def coded(width: int = WIDTH) -> np.ndarray:
    """A panorama whose colours are its directions."""
    return np.round(127.5 + 127.5 * directions(width)).astype(np.uint8)


class Cut(NamedTuple):
    """A face: its direction, pixels and mask, and its pinhole camera."""

    name: str
    pixels: np.ndarray
    mask: np.ndarray | None
    focal_px: float
    turn: tuple[float, float, float, float]


def faces(pixels: np.ndarray, mask: np.ndarray | None = None) -> Iterator[Cut]:
    """The faces of a panorama."""
    outside = "" if mask is None else IGNORE
    whole = MaskedPhoto(Decoded(pixels, pixels.shape[1::-1], Exif()), mask, outside)
    photo = Photo("a.png", "photos/a.png", *whole.decoded.stored, None, "camera", 1.0, 0.0, None)
    for part, cut in face_photos(photo, whole):
        assert part.face is not None
        assert part.focal_px is not None
        name = part.name.removeprefix("a.png/")
        yield Cut(name, cut.decoded.pixels, cut.mask, part.focal_px, part.face.turn)


def rays(face: Cut) -> np.ndarray:
    """[S, S, 3] the unit direction of each pixel of a face, in the panorama's axes."""
    side = len(face.pixels)
    at = (np.arange(side) + 0.5 - side / 2) / face.focal_px
    u, v = np.meshgrid(at, at)
    seen = np.stack([u, v, np.ones_like(u)], -1) @ matrices_of(np.array(face.turn))
    return np.asarray(seen / np.linalg.norm(seen, axis=-1, keepdims=True))


def ingested(folder: Path, **settings: object) -> tuple[Capture, Report]:
    report = Report()
    options = IngestSettings(**settings)  # type: ignore[arg-type]
    return ingest.run({"photos": folder}, options, folder.parent / "out", report), report


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Three panoramas."""
    found = tmp_path / "photos"
    found.mkdir()
    for number in range(3):
        Image.fromarray(sphere(number)).save(found / f"{number}.png")
    return found


def test_every_pixel_of_every_face_shows_its_direction() -> None:
    cut = list(faces(coded()))
    assert len(cut) == len(DIRECTIONS)
    for face in cut:
        wanted = 127.5 + 127.5 * rays(face)
        # Half a step of rounding, twice; next to the poles, columns are blended.
        assert np.abs(face.pixels - wanted).max() < 2.5, face.name


@pytest.mark.parametrize(
    ("name", "colour", "turn"),
    [
        ("000+25", (128, 74, 243), (COS, -SIN, 0, 0)),
        ("180-25", (128, 181, 12), (0, 0, COS, SIN)),
        ("000+90", (128, 0, 128), (0.5**0.5, -(0.5**0.5), 0, 0)),
        ("000-90", (128, 255, 128), (0.5**0.5, 0.5**0.5, 0, 0)),
    ],
)
def test_ahead_behind_up_and_down(name: str, colour: tuple[int, ...], turn: object) -> None:
    (face,) = [face for face in faces(coded()) if face.name == name]
    middle = len(face.pixels) // 2
    assert np.abs(face.pixels[middle, middle].astype(int) - colour).max() <= 2
    alike = abs(float(np.dot(face.turn, np.array(turn, float))))  # q and -q are one rotation
    assert alike == pytest.approx(1.0, abs=1e-12)


def test_the_x_axes_of_faces_are_level_so_that_the_scene_can_be_levelled() -> None:
    assert all(abs(face_rotation(*at)[0, 1]) < 1e-12 for at in DIRECTIONS)


def test_faces_show_the_whole_sphere() -> None:
    some = directions(256).reshape(-1, 3)
    reach = np.tan(np.radians(FIELD_DEG / 2)) * (1 + 1e-9)
    seen = np.zeros(len(some), np.bool_)
    for at in DIRECTIONS:
        x, y, z = face_rotation(*at) @ some.T
        seen |= (z > 0) & (np.maximum(np.abs(x), np.abs(y)) <= reach * z)
    assert seen.all()


def test_a_face_has_as_many_pixels_a_degree_as_the_horizon() -> None:
    face = next(faces(coded()))
    assert face.focal_px == pytest.approx(WIDTH / (2 * np.pi), rel=0.01)
    assert len(face.pixels) == int(WIDTH / WIDTHS)


def test_faces_that_a_mask_leaves_nothing_of_are_left_out() -> None:
    mask = np.where(directions()[..., 1] < 0.5, np.uint8(255), np.uint8(0))  # of 30 degrees below
    found = {face.name: face for face in faces(coded(), mask)}
    assert sorted(found) == sorted(face.name for face in faces(coded()) if face.name != "000-90")
    for face in found.values():
        assert face.mask is not None
        clear = np.abs(rays(face)[..., 1] - 0.5) > 0.02
        assert ((face.mask > 0) == (rays(face)[..., 1] < 0.5))[clear].all()


def test_a_capture_of_panoramas_is_a_capture_of_their_faces(folder: Path) -> None:
    capture, report = ingested(folder)
    assert len(capture.photos) == 3 * len(DIRECTIONS)
    assert report.metrics["panoramas"] == report.metrics["photographs"] == 3
    assert [photo.source for photo in capture.photos[:13]] == [*["0.png"] * 12, "1.png"]
    first = capture.photos[1]
    assert first.face is not None
    assert (first.name, first.image) == ("0.png/072+25", "photos/0.png/072+25.png")
    assert np.allclose(matrices_of(np.array(first.face.turn)), face_rotation(72, 25), atol=1e-12)
    assert len({photo.camera for photo in capture.photos}) == len(DIRECTIONS)
    assert len({photo.face.rig for photo in capture.photos if photo.face}) == 1
    assert capture_file.load_capture(capture.folder) == capture


def test_a_rig_mask_hides_the_same_part_of_every_panorama(folder: Path, tmp_path: Path) -> None:
    keep = np.where(directions(512)[..., 1] < 0.5, 255, 0).astype(np.uint8)
    Image.fromarray(keep).save(tmp_path / "rig.png")
    capture, _ = ingested(folder, rig_mask=tmp_path / "rig.png")
    assert len(capture.photos) == 3 * (len(DIRECTIONS) - 1)
    assert {photo.outside for photo in capture.photos} == {IGNORE}
    assert all((capture.folder / photo.mask).is_file() for photo in capture.photos)


@pytest.mark.parametrize(("name", "why"), [("none.png", "does not exist"), ("", "is a folder")])
def test_a_rig_mask_that_is_no_file_is_refused(
    folder: Path, tmp_path: Path, name: str, why: str
) -> None:
    with pytest.raises(SplatError, match=why) as caught:
        ingested(folder, rig_mask=tmp_path / name)
    assert caught.value.code == "file-missing"


def test_a_rig_mask_of_another_shape_and_one_without_use_are_named(
    folder: Path, tmp_path: Path
) -> None:
    path = tmp_path / "rig.png"
    Image.fromarray(np.full((100, 100), 255, np.uint8)).save(path)
    with pytest.raises(SplatError) as raised:
        ingested(folder, rig_mask=path)
    assert raised.value.code == "mask-unfit"
    for number in range(3):
        Image.fromarray(sphere(number)[:, :300]).save(folder / f"{number}.png")
    _, report = ingested(folder, rig_mask=path)
    assert "ingest-rig-mask-unused" in dict(report.warnings)


def test_frames_of_a_stitched_video_are_panoramas(tmp_path: Path) -> None:
    turning = (np.roll(sphere(5), 4 * i, axis=1) for i in range(40))
    film(tmp_path / "around.mp4", turning, size=(512, 256))
    capture, _ = ingested(tmp_path / "around.mp4", frames=4)
    assert len(capture.photos) == 4 * len(DIRECTIONS)
    assert {photo.source.split("/")[0] for photo in capture.photos} == {"around.mp4"}
    assert len({photo.face.rig for photo in capture.photos if photo.face}) == 1


def test_a_film_of_two_fisheyes_is_refused_and_says_what_to_do(tmp_path: Path) -> None:
    shown = (two_fisheyes(i) for i in range(20))
    film(tmp_path / "raw.mp4", shown, size=(512, 256))
    with pytest.raises(SplatError) as raised:
        ingested(tmp_path / "raw.mp4", frames=4)
    assert "a pair of fisheye pictures side by side" in raised.value.given
    assert "Stitch it" in raised.value.hint


def test_all_faces_of_a_panorama_are_on_one_side_of_the_split() -> None:
    camera = Camera(4, 4, 2.0, 2.0, 2.0, 2.0, np.eye(4))
    views = tuple(
        View(f"{number:02d}.jpg/{face}", "", camera, frame=f"{number:02d}.jpg")
        for number in range(12)
        for face in range(8)
    )
    training, held_out = split_held_out(views)
    assert sorted({view.frame for view in held_out}) == ["00.jpg", "08.jpg"]
    assert (len(training), len(held_out)) == (10 * 8, 2 * 8)
