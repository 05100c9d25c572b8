"""Films as other programs read them."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from stages.base.errors import SplatError
from stages.viewer.sinks import (
    eight_bits,
    film,
    save_picture,
)
from tests.tolerances import FILM_LEVELS

COLOURS = [(255, 0, 0), (0, 255, 0), (0, 0, 255), (128, 128, 128), (200, 100, 50), (10, 200, 150)]


def plain(colour: tuple[int, ...], width: int = 96, height: int = 64) -> np.ndarray:
    return np.full((height, width, 3), colour, np.uint8)


def made(path: Path, fps: float = 25.0) -> Path:
    with film(path, 96, 64, fps) as add:
        for colour in COLOURS:
            add(plain(colour))
    return path


def test_opencv_reads_every_frame_at_its_size_and_speed(tmp_path: Path) -> None:
    video = cv2.VideoCapture(str(made(tmp_path / "a.mp4")))
    assert video.get(cv2.CAP_PROP_FRAME_COUNT) == len(COLOURS)
    assert video.get(cv2.CAP_PROP_FPS) == 25
    for colour in COLOURS:
        there, frame = video.read()
        assert there
        assert frame.shape == (64, 96, 3)
        assert np.abs(frame[..., ::-1].astype(int) - colour).max() <= FILM_LEVELS
    assert not video.read()[0]


def test_a_film_has_the_metadata_that_players_need(tmp_path: Path) -> None:
    import av

    path = made(tmp_path / "a.mp4", fps=30000 / 1001)
    with av.open(str(path)) as container:
        stream: Any
        (stream,) = container.streams
        context = stream.codec_context
        assert (context.name, stream.pix_fmt) == ("h264", "yuv420p")
        assert (context.color_primaries, context.color_trc, context.colorspace) == (1, 1, 1)
        assert context.color_range == 1
        assert (stream.average_rate.numerator, stream.average_rate.denominator) == (30000, 1001)
        seconds = float(stream.duration * stream.time_base)
        assert seconds == pytest.approx(len(COLOURS) * 1001 / 30000, rel=1e-3)
    content = path.read_bytes()
    assert content.index(b"moov") < content.index(b"mdat")  # it starts before it is loaded whole


@pytest.mark.parametrize("stop", [KeyboardInterrupt, RuntimeError])
def test_a_film_that_is_stopped_leaves_the_old_one_and_nothing_else(tmp_path: Path, stop) -> None:
    path = tmp_path / "a.mp4"
    path.write_bytes(b"old")

    def stopped() -> None:
        with film(path, 96, 64, 30) as add:
            add(plain(COLOURS[0]))
            raise stop

    with pytest.raises(stop):
        stopped()
    assert path.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["a.mp4"]


def noisy(path: Path) -> None:
    rng = np.random.default_rng(0)
    with film(path, 96, 64, 30) as add:
        for _ in range(60):
            add(rng.integers(0, 256, (64, 96, 3), np.uint8))


@pytest.mark.skipif(os.name != "posix", reason="limits what a file may hold")
def test_a_full_disk_is_reported(tmp_path: Path) -> None:
    import resource

    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, hard))
    try:
        with pytest.raises(SplatError) as caught:
            noisy(tmp_path / "a.mp4")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert caught.value.code == "file-not-written"
    assert os.listdir(tmp_path) == []


def test_a_missing_folder_is_reported(tmp_path: Path) -> None:
    with pytest.raises(SplatError) as caught, film(tmp_path / "no" / "a.mp4", 96, 64, 30):
        pass
    assert caught.value.code == "file-not-written"


def test_a_size_that_the_encoder_refuses_is_reported(tmp_path: Path) -> None:
    with (
        pytest.raises(SplatError) as caught,
        film(tmp_path / "a.mp4", 20_000, 2, 30) as add,
    ):
        add(plain(COLOURS[0], 20_000, 2))
    assert caught.value.code == "film-encoder"
    assert "20000 x 2" in caught.value.wanted


def test_odd_sizes_raise_value_error(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="even"), film(tmp_path / "a.mp4", 95, 64, 30):
        pass


def test_depth_is_read_back_exactly(tmp_path: Path) -> None:
    depth = np.random.default_rng(1).normal(5, 2, (7, 9)).astype(np.float32)
    save_picture(tmp_path / "a.tiff", depth)
    read = cv2.imread(str(tmp_path / "a.tiff"), cv2.IMREAD_UNCHANGED)
    assert read is not None
    assert read.dtype == np.float32
    np.testing.assert_array_equal(read, depth)


def test_pictures_are_read_back_exactly(tmp_path: Path) -> None:
    image = np.array([[[0.0, 0.5, 1.0], [2.0, -1.0, np.nan]]])
    save_picture(tmp_path / "a.png", eight_bits(image))
    read = cv2.imread(str(tmp_path / "a.png"))
    assert read is not None
    assert read[..., ::-1].tolist() == [[[0, 128, 255], [255, 0, 0]]]
