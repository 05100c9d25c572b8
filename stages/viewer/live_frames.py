"""Pictures of work in progress, for whoever asks, drawn by the thread that does the work.

Whoever asks waits in a thread of their own; the worker never waits for anybody. It draws between
two of its steps, where nothing changes under the kernels, one picture at a time.
"""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from stages.base.stage import DrawView
from stages.scene import Camera

SHARE = 0.2  # of the worker's time, at most, goes into pictures
LOOKING_S = 5.0  # how long after a sign of life somebody is taken to be there still


@dataclass(frozen=True)
class Picture:
    """pixels [H, W, 3] sRGB, after `step` steps. seconds: what drawing it took of the work."""

    pixels: NDArray[np.uint8]
    step: int
    seconds: float


@dataclass
class _Wish:
    camera: Camera
    answered: threading.Event = field(default_factory=threading.Event)
    picture: Picture | None = None
    given_up: bool = False


class Pictures:
    """Between one worker, which offers, and any number of onlookers, who ask.

    seconds: what all pictures together have taken of the worker's time.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._wishes: queue.Queue[_Wish] = queue.Queue(maxsize=1)
        self._not_before = self._seen = -np.inf
        self._camera: Camera | None = None
        self._last: Picture | None = None
        self._closed = False
        self.seconds = 0.0

    def ask(self, camera: Camera, patience_s: float) -> Picture | None:
        """The next picture from `camera`; None if there is none within twice `patience_s`. After
        the end of the work, its last picture, whatever the camera."""
        self._camera = camera
        self.looked()
        if self._closed:
            return self._last
        wish = _Wish(camera)
        try:
            self._wishes.put(wish, timeout=patience_s)
        except queue.Full:
            return None
        wish.given_up = not wish.answered.wait(patience_s)
        return wish.picture or self._last

    def looked(self) -> None:
        """Somebody is there, even if the picture that they have will do for a while."""
        self._seen = self._clock()

    def watched(self) -> bool:
        """Whether somebody was there a moment ago."""
        return self._clock() - self._seen < LOOKING_S

    def offer(self, draw: DrawView, step: int) -> None:
        """Draw what is wanted, if anything is and the time for it has come."""
        if self._wishes.empty() or self._clock() < self._not_before:
            return
        wish = self._wishes.get_nowait()
        if not wish.given_up:
            wish.picture = self._drawn(draw, wish.camera, step)
            wish.answered.set()

    def offer_last(self, draw: DrawView, step: int) -> None:
        """The work is done: one more picture for whoever is looking, which stays."""
        if self._camera is not None and self.watched():
            self._last = self._drawn(draw, self._camera, step)
        self.close()

    def close(self) -> None:
        """No more pictures: nobody waits any longer."""
        self._closed = True
        while not self._wishes.empty():
            self._wishes.get_nowait().answered.set()

    def _drawn(self, draw: DrawView, camera: Camera, step: int) -> Picture | None:
        start = self._clock()
        try:
            pixels = draw(camera)
        except MemoryError:  # a picture that does not fit must not end the work
            return None
        finally:
            end = self._clock()
            self.seconds += end - start
            self._not_before = end + (end - start) * (1 / SHARE - 1)
        return Picture(pixels, step, end - start)
