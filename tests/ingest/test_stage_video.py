"""From a video, or a folder that holds some, to a capture."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from stages.base.errors import SplatError
from stages.base.stage import Report
from stages.ingest import stage as ingest
from stages.ingest.settings import IngestSettings
from stages.run.digests import record_files
from stages.scene import Capture
from stages.scene.pictures import load_image
from tests.ingest.films import WIDTH, at, film, smeared, sound, turned
from tests.ingest.made_files import folder_of

STEPS = range(90)
PIXELS = 5  # that the camera moves from one frame to the next
OTHER = (
    14.0  # mean difference of two frames that follow each other; of a frame and itself, coded: 5
)


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return walk(tmp_path_factory.mktemp("films") / "plain.mp4", sound=True)


@pytest.fixture
def video(plain: Path, tmp_path: Path) -> Path:
    """A copy to spoil."""
    return Path(shutil.copyfile(plain, tmp_path / "walk.mp4"))


def walk(path: Path, **options: object) -> Path:
    """Along the wall, 90 frames, every fifth of them blurred."""
    shown = (smeared(at(PIXELS * i)) if i % 5 == 2 else at(PIXELS * i) for i in STEPS)
    return film(path, shown, **options)  # type: ignore[arg-type]


def ingested(photos: Path, out: Path, frames: int = 0) -> tuple[Capture, dict[str, str], Report]:
    report = Report()
    capture = ingest.run({"photos": photos}, IngestSettings(frames=frames), out, report)
    return capture, dict(report.warnings), report


@pytest.mark.parametrize("in_folder", [False, True])
@pytest.mark.parametrize("option", ["masks", "depth"])
def test_masks_and_depth_maps_of_a_video_are_refused_with_what_to_do(
    video: Path, tmp_path: Path, option: str, in_folder: bool
) -> None:
    (tmp_path / "more").mkdir()
    (tmp_path / "more" / "walk.mp4.png").write_bytes(b"")
    settings = IngestSettings(**{option: tmp_path / "more"})  # type: ignore[arg-type]
    photos = video
    if in_folder:
        photos = tmp_path / "films"
        photos.mkdir()
        video.rename(photos / "walk.mp4")
    with pytest.raises(SplatError) as caught:
        ingest.run({"photos": photos}, settings, tmp_path / "out", Report())
    assert caught.value.code == "ingest-video-alone"
    assert "1-ingest/photos/walk.mp4" in caught.value.hint


def numbers(capture: Capture) -> list[int]:
    return [int(Path(photo.name).stem) for photo in capture.photos]


def picture(capture: Capture, position: int) -> np.ndarray:
    photo = capture.photos[position]
    return 255 * load_image(capture.folder / photo.image, photo.width, photo.height)


def test_a_video_gives_sharp_frames_that_are_what_was_filmed(video: Path, tmp_path: Path) -> None:
    capture, _, report = ingested(video, tmp_path / "out")
    found = numbers(capture)
    assert all(number % 5 != 2 for number in found)
    assert len(found) == pytest.approx(90 * PIXELS / WIDTH / 0.05, abs=3)
    for position, number in enumerate(found):
        assert np.abs(picture(capture, position) - at(PIXELS * number)).mean() < OTHER / 2
    assert len({photo.camera for photo in capture.photos}) == 1
    assert ingest.load(capture.folder) == capture
    facts = report.metrics["videos"][0]
    assert [one["number"] for one in facts["chosen"]] == found
    assert facts["frames"] == 90
    assert facts["colours"] == "read as sRGB"


def test_as_many_frames_as_asked_for(video: Path, tmp_path: Path) -> None:
    capture, _, _ = ingested(video, tmp_path / "out", frames=11)
    assert len(capture.photos) == 11


def test_the_same_video_gives_the_same_bytes(video: Path, tmp_path: Path) -> None:
    digests = []
    for name in ("a", "b"):
        capture, _, _ = ingested(video, tmp_path / name)
        records = record_files(capture.folder)
        digests.append({name: record.sha256 for name, record in records.items()})
    assert digests[0] == digests[1]


def test_a_folder_of_photographs_and_videos_gives_both(video: Path, tmp_path: Path) -> None:
    folder = folder_of(tmp_path / "photos")
    shutil.copyfile(video, folder / "a, b.mp4")
    shutil.copyfile(video, folder / "clip.mkv")
    shutil.copyfile(video, folder / "IMG_1.MOV")  # a live picture's: its photograph is there
    capture, _, report = ingested(folder, tmp_path / "out", frames=5)
    names = [photo.name for photo in capture.photos]
    assert sum(name.startswith("IMG_") for name in names) == 3
    assert sum(name.startswith("a, b.mp4/") for name in names) == 5
    assert sum(name.startswith("clip.mkv/") for name in names) == 5
    assert len({photo.camera for photo in capture.photos}) == 3
    assert [facts["name"] for facts in report.metrics["videos"]] == ["a, b.mp4", "clip.mkv"]


MATRICES = {  # what shows a stored picture as it should be
    (1, 0, 0, 1): lambda stored: stored,
    (0, 1, -1, 0): lambda stored: cv2.rotate(stored, cv2.ROTATE_90_CLOCKWISE),
    (-1, 0, 0, -1): lambda stored: cv2.rotate(stored, cv2.ROTATE_180),
    (0, -1, 1, 0): lambda stored: cv2.rotate(stored, cv2.ROTATE_90_COUNTERCLOCKWISE),
    (-1, 0, 0, 1): lambda stored: stored[:, ::-1],
    (1, 0, 0, -1): lambda stored: stored[::-1],
    (0, 1, 1, 0): lambda stored: stored.transpose(1, 0, 2),
    (0, -1, -1, 0): lambda stored: stored[::-1, ::-1].transpose(1, 0, 2),
}


@pytest.mark.parametrize("matrix", MATRICES)
def test_frames_stand_upright(
    video: Path, tmp_path: Path, matrix: tuple[int, int, int, int]
) -> None:
    capture, _, _ = ingested(turned(video, matrix), tmp_path / "out", frames=4)
    expected = MATRICES[matrix](at(PIXELS * numbers(capture)[0]))
    assert picture(capture, 0).shape == expected.shape
    assert np.abs(picture(capture, 0) - expected).mean() < OTHER / 2


def test_a_variable_frame_rate_changes_nothing_but_the_times(video: Path, tmp_path: Path) -> None:
    times = np.cumsum(np.random.default_rng(0).uniform(0.02, 0.2, 90))
    steady, _, _ = ingested(video, tmp_path / "a")
    varied, _, report = ingested(walk(tmp_path / "b.mp4", seconds=times), tmp_path / "b")
    assert numbers(varied) == pytest.approx(numbers(steady), abs=3)
    chosen = report.metrics["videos"][0]["chosen"]
    expected = [times[one["number"]] - times[0] for one in chosen]
    assert [one["seconds"] for one in chosen] == pytest.approx(expected, abs=0.002)


def test_a_sound_track_beside_the_picture_is_ignored(video: Path, tmp_path: Path) -> None:
    silent, _, _ = ingested(walk(tmp_path / "a.mp4"), tmp_path / "a")
    loud, _, _ = ingested(video, tmp_path / "b")
    assert numbers(loud) == numbers(silent)


def test_high_dynamic_range_is_mapped_and_named(tmp_path: Path) -> None:
    colours = {"colorspace": 9, "color_primaries": 9, "color_trc": 18}
    video = walk(tmp_path / "hlg.mp4", pixel_format="yuv420p10le", colours=colours)
    _, warnings, report = ingested(video, tmp_path / "out", frames=4)
    assert "HLG" in report.metrics["videos"][0]["colours"]
    assert "BT.2390" in warnings["ingest-video-hdr"]


def test_a_film_that_breaks_off_is_used_as_far_as_it_goes(tmp_path: Path) -> None:
    options = {"movflags": "+faststart"}
    video = walk(tmp_path / "walk.mp4", container_options=options, crf=20)
    whole = video.read_bytes()
    video.write_bytes(whole[: len(whole) * 55 // 100])
    capture, warnings, report = ingested(video, tmp_path / "out")
    assert numbers(capture)[-1] < report.metrics["videos"][0]["frames"]
    assert 20 < report.metrics["videos"][0]["frames"] < 80
    assert "walk.mp4 is damaged, 2 s at its end are missing" in warnings["ingest-video-damaged"]


def test_a_slow_film_is_whole_where_its_last_picture_stands_long(tmp_path: Path) -> None:
    video = tmp_path / "slow.gif"
    first, *others = (Image.fromarray(at(30.0 * i)) for i in range(8))
    first.save(video, save_all=True, append_images=others, duration=2000)
    _, warnings, report = ingested(video, tmp_path / "out")
    assert report.metrics["videos"][0]["missing_seconds"] == 0
    assert "ingest-video-damaged" not in warnings


def broken(video: Path, kind: str) -> Path:
    if kind == "encrypted":
        key = {f"encryption_{name}": "00112233445566778899aabbccddeeff" for name in ("key", "kid")}
        return walk(video, container_options={"encryption_scheme": "cenc-aes-ctr", **key})
    if kind == "empty":
        video.write_bytes(b"")
    elif kind == "without index":
        video.write_bytes(video.read_bytes()[:2000])
    elif kind == "text":
        video.write_text("#EXTM3U\n#EXTINF:1,\nfile:///etc/passwd\n")
    elif kind == "only sound":
        sound(video)
    return video


@pytest.mark.parametrize(("kind", "reason"), [
    ("encrypted", "encrypted"), ("empty", "the file is empty"), ("without index", "index"),
    ("text", "does not open as a video"), ("only sound", "no video"),
])  # fmt: skip
def test_a_video_that_cannot_be_used_is_one_clear_error(
    video: Path, tmp_path: Path, kind: str, reason: str
) -> None:
    with pytest.raises(SplatError) as raised:
        ingested(broken(video, kind), tmp_path / "out")
    assert raised.value.code == "ingest-video-unusable"
    assert "walk.mp4" in raised.value.given
    assert reason in raised.value.given


def test_a_broken_video_among_photographs_is_left_out_and_named(tmp_path: Path) -> None:
    folder = folder_of(tmp_path / "photos")
    (folder / "clip.mp4").write_bytes(b"")
    capture, warnings, _ = ingested(folder, tmp_path / "out")
    assert len(capture.photos) == 3
    assert "clip.mp4 is left out: the file is empty" in warnings["ingest-left-out"]


def test_memory_hardly_grows_with_length() -> None:
    """What is kept of a frame is a few hundred bytes, however large it is."""
    from stages.ingest.frame_selection import FrameMeter

    meter = FrameMeter()
    seen = [meter.measure(at(i)[..., 0], i / 30) for i in range(20)]
    assert all(one.motion.nbytes + 16 < 400 for one in seen)
