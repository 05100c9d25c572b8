"""Frames of a training scene: drawn on request, within a share of the time."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace

import numpy as np
import pytest

from stages.scene import Camera
from stages.viewer.live_frames import LARGEST_SHARE, Frame, LiveFrames
from tests import scenes

WAIT_S = 20.0


def never(camera: Camera) -> np.ndarray:
    raise AssertionError("no frame was requested")


def flat(camera: Camera) -> np.ndarray:
    return np.full((camera.height, camera.width, 3), 7, np.uint8)


class Viewer(threading.Thread):
    """Requests one frame in a thread of its own, as the server does."""

    def __init__(self, frames: LiveFrames, camera: Camera, timeout_s: float = WAIT_S) -> None:
        super().__init__(daemon=True)
        self.answer: Frame | None = None
        self._request = lambda: frames.request(camera, timeout_s)
        self.start()

    def run(self) -> None:
        self.answer = self._request()


def waiting(frames: LiveFrames) -> None:
    """Until a request is queued."""
    deadline = time.monotonic() + WAIT_S
    while frames._requests.empty():
        assert time.monotonic() < deadline
        time.sleep(0.001)


@contextmanager
def worker(frames: LiveFrames) -> Iterator[list[int]]:
    """A thread that offers after each step; the steps it has done."""
    steps, stop = [0], threading.Event()

    def work() -> None:
        while not stop.is_set():
            steps[0] += 1
            frames.offer(flat, steps[0])
            time.sleep(0.001)

    thread = threading.Thread(target=work)
    thread.start()
    yield steps
    stop.set()
    thread.join()


def test_a_request_gets_the_frame_of_its_camera() -> None:
    frames = LiveFrames()
    viewer = Viewer(frames, scenes.camera(40, 30))
    waiting(frames)
    frames.offer(flat, 12)
    viewer.join(WAIT_S)
    assert viewer.answer is not None
    assert viewer.answer.pixels.shape == (30, 40, 3)
    assert viewer.answer.step == 12


def test_nothing_is_drawn_without_a_request() -> None:
    frames = LiveFrames()
    for step in range(1000):
        frames.offer(never, step)
    frames.offer_last(never, 1000)
    assert frames.seconds == 0


def test_nothing_is_drawn_for_an_abandoned_request() -> None:
    frames = LiveFrames()
    assert frames.request(scenes.camera(), 0.01) is None
    frames.offer(never, 1)
    with worker(frames):
        assert frames.request(scenes.camera(), WAIT_S) is not None


def test_drawing_takes_no_more_than_its_share_of_the_time() -> None:
    clock = SimpleNamespace(s=0.0)
    frames = LiveFrames(lambda: clock.s)

    def slow(camera: Camera) -> np.ndarray:
        clock.s += 0.3
        return flat(camera)

    for _ in range(5):  # a viewer that requests again at once; steps of 10 ms
        viewer = Viewer(frames, scenes.camera())
        waiting(frames)
        while viewer.is_alive():
            frames.offer(slow, 1)
            viewer.join(0.001)
            clock.s += 0.01
    assert frames.seconds == pytest.approx(5 * 0.3)
    before_the_last = clock.s - 0.3  # its own pause is still to come
    assert LARGEST_SHARE * before_the_last + 1e-9 >= 4 * 0.3


def test_several_viewers_each_get_their_own_frame() -> None:
    frames = LiveFrames()
    viewers = [Viewer(frames, scenes.camera(10 + i, 8)) for i in range(6)]
    with worker(frames):
        for viewer in viewers:
            viewer.join(WAIT_S)
    shapes = [None if a.answer is None else a.answer.pixels.shape for a in viewers]
    assert shapes == [(8, 10 + i, 3) for i in range(6)]


def test_the_last_frame_is_kept_for_a_viewer() -> None:
    frames = LiveFrames()
    with worker(frames):
        frames.request(scenes.camera(40, 30), WAIT_S)
    frames.offer_last(flat, 99)
    last = frames.request(scenes.camera(20, 10), WAIT_S)
    assert last is not None
    assert (last.step, last.pixels.shape) == (99, (30, 40, 3))


def test_a_viewer_that_polls_only_the_state_is_still_there() -> None:
    clock = SimpleNamespace(s=0.0)
    frames = LiveFrames(lambda: clock.s)
    viewer = Viewer(frames, scenes.camera(40, 30))
    waiting(frames)
    frames.offer(flat, 1)
    viewer.join(WAIT_S)
    for _ in range(20):
        clock.s += 1.0
        frames.mark_watched()
    assert frames.is_watched()
    frames.offer_last(flat, 99)
    last = frames.request(scenes.camera(40, 30), WAIT_S)
    assert last is not None
    assert last.step == 99


def test_no_request_waits_for_training_that_has_ended() -> None:
    frames = LiveFrames()
    viewer = Viewer(frames, scenes.camera(), timeout_s=60)
    waiting(frames)
    frames.close()
    viewer.join(WAIT_S)
    assert not viewer.is_alive()
    assert viewer.answer is None
    assert frames.request(scenes.camera(), 60) is None


def test_a_frame_that_does_not_fit_into_memory_does_not_end_the_training() -> None:
    def too_large(camera: Camera) -> np.ndarray:
        raise MemoryError

    frames = LiveFrames()
    viewer = Viewer(frames, scenes.camera())
    waiting(frames)
    frames.offer(too_large, 1)
    viewer.join(WAIT_S)
    assert viewer.answer is None
