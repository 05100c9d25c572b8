"""Frames of a training scene on request, drawn by the training thread itself.

Requests wait in threads of their own; the training thread never waits. It draws between two steps,
where no kernel is running, one frame at a time.
"""

from __future__ import annotations

import queue
import time
from collections.abc import Callable
from concurrent.futures import CancelledError, Future
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stages.base.errors import SplatError
from stages.base.stage import DrawView
from stages.scene import Camera

LARGEST_SHARE = 0.2  # of the training thread's time that goes into frames
WATCHED_FOR_S = 5.0  # after the last request a viewer is taken to be still there


@dataclass(frozen=True)
class Frame:
    """pixels [H, W, 3] uint8 sRGB, after `step` steps. seconds: what drawing it took."""

    pixels: NDArray[np.uint8]
    step: int
    seconds: float


class LiveFrames:
    """Connects one training thread, which offers to draw, with any number of requests.

    seconds: what all frames together have taken of the training thread's time.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._requests: queue.Queue[tuple[Camera, Future[Frame | None]]] = queue.Queue(maxsize=1)
        self._not_before = self._last_seen = -np.inf
        self._camera: Camera | None = None
        self._last: Frame | None = None
        self._closed = False
        self.seconds = 0.0

    def request(self, camera: Camera, timeout_s: float) -> Frame | None:
        """The next frame from `camera`; None if there is none within twice `timeout_s`. After the
        end of training, the last frame, whatever the camera."""
        self._camera = camera
        self.mark_watched()
        if self._closed:
            return self._last
        frame: Future[Frame | None] = Future()
        try:
            self._requests.put((camera, frame), timeout=timeout_s)
        except queue.Full:
            return None
        try:
            return frame.result(timeout_s) or self._last
        except (TimeoutError, CancelledError):
            frame.cancel()
            return self._last

    def mark_watched(self) -> None:
        """Note that a viewer is there, even if it requests no frame for a while."""
        self._last_seen = self._clock()

    def is_watched(self) -> bool:
        """Whether a viewer was there in the last `WATCHED_FOR_S`."""
        return self._clock() - self._last_seen < WATCHED_FOR_S

    def offer(self, draw: DrawView, step: int) -> None:
        """Draw the requested frame, if there is one and `LARGEST_SHARE` allows it."""
        if self._requests.empty() or self._clock() < self._not_before:
            return
        camera, frame = self._requests.get_nowait()
        if frame.set_running_or_notify_cancel():
            frame.set_result(self._draw(draw, camera, step))

    def offer_last(self, draw: DrawView, step: int) -> None:
        """Training has ended: draw one more frame for the viewer, which is kept."""
        if self._camera is not None and self.is_watched():
            self._last = self._draw(draw, self._camera, step)
        self.close()

    def close(self) -> None:
        """Draw no more frames, and let no request wait any longer."""
        self._closed = True
        while not self._requests.empty():
            self._requests.get_nowait()[1].cancel()

    def _draw(self, draw: DrawView, camera: Camera, step: int) -> Frame | None:
        start = self._clock()
        try:
            pixels = draw(camera)
        except (MemoryError, SplatError):  # a frame that does not fit must not end the training
            return None
        finally:
            end = self._clock()
            self.seconds += end - start
            self._not_before = end + (end - start) * (1 / LARGEST_SHARE - 1)
        return Frame(pixels, step, end - start)
