"""Pictures of work in progress: drawn for whoever asks, and never at the worker's expense."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace

import numpy as np
import pytest

from stages.scene import Camera
from stages.viewer.live_frames import SHARE, Picture, Pictures
from tests import scenes

WAIT_S = 20.0


def never(camera: Camera) -> np.ndarray:
    raise AssertionError("nobody asked")


def flat(camera: Camera) -> np.ndarray:
    return np.full((camera.height, camera.width, 3), 7, np.uint8)


class Asker(threading.Thread):
    """Asks once, in a thread of its own, as the server does."""

    def __init__(self, pictures: Pictures, camera: Camera, patience_s: float = WAIT_S) -> None:
        super().__init__(daemon=True)
        self.answer: Picture | None = None
        self._ask = lambda: pictures.ask(camera, patience_s)
        self.start()

    def run(self) -> None:
        self.answer = self._ask()


def waiting(pictures: Pictures) -> None:
    """Until a wish lies there."""
    deadline = time.monotonic() + WAIT_S
    while pictures._wishes.empty():
        assert time.monotonic() < deadline
        time.sleep(0.001)


@contextmanager
def worker(pictures: Pictures) -> Iterator[list[int]]:
    """A thread that offers after each step; the steps it has done."""
    steps, stop = [0], threading.Event()

    def work() -> None:
        while not stop.is_set():
            steps[0] += 1
            pictures.offer(flat, steps[0])
            time.sleep(0.001)

    thread = threading.Thread(target=work)
    thread.start()
    yield steps
    stop.set()
    thread.join()


def test_whoever_asks_gets_the_picture_from_there() -> None:
    pictures = Pictures()
    asker = Asker(pictures, scenes.camera(40, 30))
    waiting(pictures)
    pictures.offer(flat, 12)
    asker.join(WAIT_S)
    assert asker.answer is not None
    assert asker.answer.pixels.shape == (30, 40, 3)
    assert asker.answer.step == 12


def test_nothing_is_drawn_while_nobody_looks() -> None:
    pictures = Pictures()
    for step in range(1000):
        pictures.offer(never, step)
    pictures.offer_last(never, 1000)
    assert pictures.seconds == 0


def test_nothing_is_drawn_for_those_who_left() -> None:
    pictures = Pictures()
    assert pictures.ask(scenes.camera(), 0.01) is None
    pictures.offer(never, 1)
    with worker(pictures):
        assert pictures.ask(scenes.camera(), WAIT_S) is not None


def test_drawing_takes_no_more_than_its_share_of_the_time() -> None:
    clock = SimpleNamespace(s=0.0)
    pictures = Pictures(lambda: clock.s)

    def slow(camera: Camera) -> np.ndarray:
        clock.s += 0.3
        return flat(camera)

    for _ in range(5):  # somebody who always asks again at once; steps of 10 ms
        asker = Asker(pictures, scenes.camera())
        waiting(pictures)
        while asker.is_alive():
            pictures.offer(slow, 1)
            asker.join(0.001)
            clock.s += 0.01
    assert pictures.seconds == pytest.approx(5 * 0.3)
    before_the_last = clock.s - 0.3  # its own pause is still to come
    assert SHARE * before_the_last + 1e-9 >= 4 * 0.3


def test_several_onlookers_each_get_their_own() -> None:
    pictures = Pictures()
    askers = [Asker(pictures, scenes.camera(10 + i, 8)) for i in range(6)]
    with worker(pictures):
        for asker in askers:
            asker.join(WAIT_S)
    shapes = [None if a.answer is None else a.answer.pixels.shape for a in askers]
    assert shapes == [(8, 10 + i, 3) for i in range(6)]


def test_the_last_picture_stays_for_those_who_were_looking() -> None:
    pictures = Pictures()
    with worker(pictures):
        pictures.ask(scenes.camera(40, 30), WAIT_S)
    pictures.offer_last(flat, 99)
    last = pictures.ask(scenes.camera(20, 10), WAIT_S)
    assert last is not None
    assert (last.step, last.pixels.shape) == (99, (30, 40, 3))


def test_who_rests_on_a_picture_that_took_long_is_still_looking() -> None:
    clock = SimpleNamespace(s=0.0)
    pictures = Pictures(lambda: clock.s)
    asker = Asker(pictures, scenes.camera(40, 30))
    waiting(pictures)
    pictures.offer(flat, 1)
    asker.join(WAIT_S)
    for _ in range(20):
        clock.s += 1.0
        pictures.looked()
    assert pictures.watched()
    pictures.offer_last(flat, 99)
    last = pictures.ask(scenes.camera(40, 30), WAIT_S)
    assert last is not None
    assert last.step == 99


def test_nobody_waits_for_work_that_has_ended() -> None:
    pictures = Pictures()
    asker = Asker(pictures, scenes.camera(), patience_s=60)
    waiting(pictures)
    pictures.close()
    asker.join(WAIT_S)
    assert not asker.is_alive()
    assert asker.answer is None
    assert pictures.ask(scenes.camera(), 60) is None


def test_a_picture_that_does_not_fit_into_memory_does_not_end_the_work() -> None:
    def too_large(camera: Camera) -> np.ndarray:
        raise MemoryError

    pictures = Pictures()
    asker = Asker(pictures, scenes.camera())
    waiting(pictures)
    pictures.offer(too_large, 1)
    asker.join(WAIT_S)
    assert asker.answer is None
