"""`splat render`: pictures, films and folders, and what cannot be drawn."""

from __future__ import annotations

import json
import os
import re
import signal
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from splatcli.commands.render import _draw_all
from stages import formats
from stages.base import memory
from stages.base.errors import Interrupted
from stages.cameras import nerfstudio
from stages.raster.definition import Rendering
from stages.raster.draw import render
from stages.raster.similarity import Similarity, rotation_about
from stages.run import results
from stages.scene import Camera, View, look_at
from stages.viewer.sinks import eight_bits
from tests import processes, scenes
from tests.processes import line_of, running
from tests.tolerances import FILM_LEVELS

CLOUD = scenes.cloud(60)


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    formats.write(tmp_path / "a.ply", CLOUD)
    return tmp_path / "a.ply"


def around(count: int = 8) -> tuple[View, ...]:
    middle = np.array([0.0, 0.0, 4.0])
    made = []
    for i, angle in enumerate(np.linspace(0, 2 * np.pi, count, endpoint=False)):
        eye = middle + 3 * np.array([np.sin(angle), -0.4, -np.cos(angle)])
        made.append(
            View(f"{i}.jpg", f"{i}.jpg", scenes.camera(64, 49, matrix=look_at(eye, middle)))
        )
    return tuple(made)


@pytest.fixture
def captured(monkeypatch: pytest.MonkeyPatch) -> tuple[View, ...]:
    """As if the file lay in a run with these photographs."""
    monkeypatch.setattr(results, "views_of", lambda pipeline: around())
    return around()


def last_event(result) -> dict:
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout.splitlines()[-1])


def frames_of(path: Path) -> list[np.ndarray]:
    video = cv2.VideoCapture(str(path))
    frames: list[np.ndarray] = []
    while True:
        there, frame = video.read()
        if not there:
            return frames
        frames.append(frame[..., ::-1])


def test_a_film_shows_what_the_pictures_show(splat, scene: Path, captured) -> None:
    words = ("render", str(scene), "--frames", "4")
    told = last_event(splat(*words, "--out", "a.mp4", "--fps", "12", "--json"))
    splat(*words, "--out", "frames", "--width", "64")
    assert (told["frames"], told["width"], told["height"]) == (4, 64, 48)  # even
    assert told["frames_a_second"] > 0
    film = frames_of(Path("a.mp4"))
    assert cv2.VideoCapture("a.mp4").get(cv2.CAP_PROP_FPS) == 12
    names = sorted(path.name for path in Path("frames").iterdir())
    assert names == [f"frame_000{i}.png" for i in (1, 2, 3, 4)]
    for frame, name in zip(film, names, strict=True):
        picture = np.array(Image.open(Path("frames") / name).resize((64, 48)))
        # Colour has half the resolution: compare what is larger than that.
        ours, theirs = (cv2.blur(p.astype(np.float32), (9, 9)) for p in (picture, frame))
        assert np.abs(ours - theirs).mean() < FILM_LEVELS


def test_how_long_a_film_is(splat, scene: Path) -> None:
    told = last_event(
        splat("render", str(scene), "-o", "a.mp4", "--seconds", "0.5", "--width", "16", "--json")
    )
    assert told["frames"] == 15


def test_depth_of_a_picture_is_what_was_rendered(splat, scene: Path, captured) -> None:
    splat("render", str(scene), "--out", "a.png", "--depth", "--camera", "3")
    drawn = render(CLOUD, captured[3].camera)
    depth = cv2.imread("a.depth.tiff", cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(depth, drawn.median_depth)
    np.testing.assert_array_equal(np.array(Image.open("a.png")), eight_bits(drawn.image))


def test_depth_of_frames(splat, scene: Path, captured) -> None:
    words = ("render", str(scene), "--frames", "2", "--width", "32", "--depth", "--out")
    splat(*words, "frames")
    assert sorted(path.name for path in Path("frames").iterdir()) == [
        *("frame_0001.depth.tiff", "frame_0001.png"),
        *("frame_0002.depth.tiff", "frame_0002.png"),
    ]


def test_the_capture_path_passes_the_photographs(splat, scene: Path, captured) -> None:
    told = last_event(
        splat(*("render", str(scene), "--path", "capture", "--frames", "5", "-o", "f", "--json"))
    )
    assert (told["frames"], told["width"], told["height"]) == (5, 64, 49)


def test_a_camera_file_is_drawn_camera_by_camera(splat, scene: Path, captured) -> None:
    nerfstudio.write(Path("transforms.json"), captured, Path("images"))
    splat("render", str(scene), "--path", "transforms.json", "--out", "f")
    pictures = sorted(Path("f").iterdir())
    for path, view in zip(pictures, captured, strict=True):
        wanted = eight_bits(render(CLOUD, view.camera).image).astype(int)
        assert np.abs(np.array(Image.open(path)) - wanted).max() <= 1
    told = last_event(
        splat(
            *("render", str(scene), "--path", "transforms.json", "--frames", "3", "--json"), "-og"
        )
    )
    assert told["frames"] == 3


def test_cameras_of_the_same_photographs_in_another_world_are_brought_into_the_runs(
    splat, scene: Path, captured
) -> None:
    """As a run's own camera file is, which was levelled and moved."""
    turn = rotation_about(np.array([1.0, 2.0, 3.0]), 70)
    world = Similarity(3.0, turn, np.array([5.0, -2.0, 9.0]))
    there = [replace(view, camera=world.apply_to_camera(view.camera)) for view in captured]
    nerfstudio.write(
        Path("t.json"), [*there[:4], replace(there[4], name="new.jpg")], Path("images")
    )
    result = splat("render", str(scene), "--path", "t.json", "--out", "f")
    assert "another world" in result.stderr
    for path, view in zip(sorted(Path("f").iterdir()), captured, strict=False):
        wanted = eight_bits(render(CLOUD, view.camera).image).astype(int)
        assert np.abs(np.array(Image.open(path)) - wanted).max() <= 1


def test_a_camera_file_beside_a_scene_far_away_is_in_its_coordinates(
    splat, tmp_path: Path, captured, monkeypatch
) -> None:
    monkeypatch.setattr(results, "views_of", lambda pipeline: ())
    there = np.array([500_000.25, 4_649_776.5, 120.125])
    far = Similarity(offset=there).apply_to_splats(CLOUD)
    assert np.abs(far.origin).max() > 1e6
    formats.write(tmp_path / "far.glb", far)
    moved = Similarity(offset=there)
    views = [replace(view, camera=moved.apply_to_camera(view.camera)) for view in captured]
    nerfstudio.write(Path("t.json"), views, Path("images"))
    splat("render", str(tmp_path / "far.glb"), "--path", "t.json", "--out", "f")
    for path, view in zip(sorted(Path("f").iterdir()), captured, strict=True):
        wanted = eight_bits(render(CLOUD, view.camera).image).astype(int)
        assert np.abs(np.array(Image.open(path)) - wanted).max() <= 2


def test_a_distorted_camera_file_is_drawn_with_a_note(splat, scene: Path, captured) -> None:
    nerfstudio.write(Path("t.json"), captured, Path("images"))
    data = json.loads(Path("t.json").read_text())
    Path("t.json").write_text(json.dumps(data | {"k1": 0.1}))
    result = splat("render", str(scene), "--path", "t.json", "--out", "a.mp4")
    assert result.exit_code == 0
    assert "distort" in result.stderr


def test_frames_of_a_longer_path_are_counted_and_kept(splat, scene: Path) -> None:
    words = ("render", str(scene), "--width", "16", "--out", "f", "--frames")
    splat(*words, "3")
    result = splat(*words, "2")
    assert "1 frames of an earlier" in result.stderr
    assert len(list(Path("f").iterdir())) == 3


def test_half_a_capture_is_reported(splat, scene: Path, monkeypatch) -> None:
    monkeypatch.setattr(results, "views_of", lambda pipeline: around(8)[:3])
    result = splat("render", str(scene), "--frames", "2", "--width", "16", "--out", "f")
    assert "81 degrees" in result.stderr


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (["--out", "a.gif"], 2, ".mp4"),
        (["--out", "a.png", "--path", "orbit"], 2, "--path"),
        (["--out", "a.png", "--frames", "3"], 2, "--frames"),
        (["--out", "a.mp4", "--camera", "0"], 2, "--camera"),
        (["--out", "a.mp4", "--frames", "0"], 2, "--frames"),
        (["--out", "a.mp4", "--fps", "0"], 2, "--fps"),
        (["--out", "a.mp4", "--frames", "3", "--seconds", "1"], 2, "--seconds"),
        (["--out", "a.mp4", "--depth"], 2, "frames"),
        (["--out", "a.mp4", "--path", "capture"], 2, "orbit"),
        (["--out", "a.mp4", "--path", "spiral"], 2, "capture"),
        (["--out", "a.mp4", "--path", "a.ply"], 2, "COLMAP"),
        (["--out", "a.mp4", "--path", "photos"], 2, "COLMAP"),
        (["--out", "a.png", "--width", "99999"], 2, "--width"),
        (["--out", "a.webp", "--width", "16384"], 2, "--out a.png"),
        (["--out", "a.png", "--backend", "magic"], 2, "backend"),
        (["--out", "no/a.mp4", "--frames", "2", "--width", "16"], 6, "folder"),
    ],
)
def test_splats_that_cannot_be_drawn_are_reported(
    splat, scene: Path, words, code: int, said: str
) -> None:
    before = sorted(os.listdir())
    result = splat("render", str(scene), *words)
    assert result.exit_code == code, result.output
    assert said in result.stderr
    assert sorted(os.listdir()) == before


def test_a_picture_larger_than_memory_is_refused_at_once(splat, scene: Path, monkeypatch) -> None:
    monkeypatch.setattr(memory, "available_mib", lambda: 100.0)
    result = splat("render", str(scene), "--out", "a.png", "--width", "4000")
    assert result.exit_code == 6
    assert "smaller --width" in result.stderr


@pytest.mark.parametrize("name", ["²", "٣", "-1", "1e3"])
def test_a_camera_that_is_no_name_and_no_number_is_refused(splat, scene: Path, name: str) -> None:
    result = splat("render", str(scene), "--out", "a.png", f"--camera={name}")
    assert result.exit_code == 2
    assert "render-camera" in result.stderr


def test_where_there_are_no_photographs_no_camera_is_advised(splat, scene: Path) -> None:
    result = splat("render", str(scene), "--out", "a.png", "--camera", "zero")
    assert result.exit_code == 2
    assert not re.search(r"number from|\d to \d", result.stderr)
    assert "none of its photographs' cameras" in " ".join(result.stderr.split())


def test_a_wrong_camera_is_told_the_right_ones(splat, scene: Path, captured) -> None:
    result = splat("render", str(scene), "--out", "a.png", "--camera", "8")
    assert "a number from 0 to 7 (0.jpg ... 7.jpg)" in " ".join(result.stderr.split())


def test_a_file_without_cameras_is_no_path(splat, scene: Path) -> None:
    Path("t.json").write_text('{"w": 1, "h": 1, "fl_x": 1, "frames": []}')
    result = splat("render", str(scene), "--path", "t.json", "--out", "a.mp4")
    assert result.exit_code == 3
    assert "no camera" in result.stderr


def test_cameras_of_other_shapes_are_shown_whole_in_a_film() -> None:
    """By hand: 60 x 90 into 90 x 60 is two thirds as large, with 25 pixels to either side."""
    tall = Camera(60, 90, 50.0, 50.0, 30.0, 45.0, np.eye(4))
    wide = tall.reframed(90, 60)
    assert (wide.width, wide.height) == (90, 60)
    assert wide.fx == wide.fy == pytest.approx(100 / 3)
    assert (wide.cx, wide.cy) == (45.0, 30.0)
    assert tall.reframed(30, 45).fx == pytest.approx(25.0)


@pytest.mark.skipif(os.name != "posix", reason="sends the signal of Ctrl-C")
def test_ctrl_c_leaves_no_half_film(scene: Path, tmp_path: Path) -> None:
    words = ("--out", str(tmp_path / "a.mp4"), "--frames", "3000", "--width", "64")
    with running(processes.splat("render", str(scene), "--json", *words)) as rendering:
        assert "progress" in line_of(rendering)
        rendering.send_signal(signal.SIGINT)
        rendering.communicate(timeout=30)
        assert rendering.returncode == 130
    assert os.listdir(tmp_path) == ["a.ply"]


@pytest.mark.skipif(os.name != "posix", reason="sends the signal of Ctrl-C")
def test_ctrl_c_stops_between_two_frames() -> None:
    """The frame that is being drawn is finished and written."""
    written: list[Rendering] = []

    def draw(camera: Camera) -> Rendering:
        signal.raise_signal(signal.SIGINT)
        alpha, depth, median = np.zeros((3, camera.height, camera.width), np.float32)
        return Rendering(np.stack([alpha] * 3, -1), alpha, depth, median, 0)

    tall = Camera(60, 90, 50.0, 50.0, 30.0, 45.0, np.eye(4))
    with pytest.raises(Interrupted, match="1 of 3 frames"):
        _draw_all(draw, [tall] * 3, nullcontext(written.append))
    assert len(written) == 1
