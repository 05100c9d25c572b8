"""Which frames of a video to use: sharp ones, evenly spaced by how far the picture moved."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import percentile_filter

from stages.photos.quality import sharpness

MEASURED_SIDE_PX = 800
_FLOW_SIDE_PX = 320
_CELLS = (6, 4)  # of the picture, whose motion is kept for each frame
STEP = 0.05  # of the longer side, from one chosen frame to the next
MOST = 300  # frames of one video, unless more are asked for
_TREMBLE = 0.01  # of the longer side: motion to and fro within it leads nowhere
WIDEST_GAP = 0.25  # of the longer side; a blurred frame is better than a wider gap
_NEARBY = 121  # frames, among which a frame is blurred or not
BLURRED_BELOW = 0.8  # of what is sharp nearby
_OFF_CENTRE = 0.2  # of sharpness, that a frame at the edge of its place must be better


@dataclass(frozen=True)
class Seen:
    """A frame as it was measured. moved [C, 2]: of the cells of the picture since the frame before,
    in parts of the longer side."""

    seconds: float
    sharpness: float
    moved: NDArray[np.float32]


@dataclass(frozen=True)
class Chosen:
    """A frame to use. number: in the video. sharpness: in parts of what is sharp nearby. moved:
    since the chosen frame before, in parts of the picture's longer side."""

    number: int
    seconds: float
    sharpness: float
    moved: float


class Watcher:
    """Measures frames one after another; keeps only the one before."""

    def __init__(self) -> None:
        self._flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST)
        self._before: NDArray[np.uint8] | None = None

    def see(self, grey: NDArray[np.uint8], seconds: float) -> Seen:
        """grey [H, W]: the next frame, its longer side at most MEASURED_SIDE_PX."""
        scale = _FLOW_SIDE_PX / max(grey.shape)
        small = np.asarray(
            cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8
        )
        moved = np.zeros((_CELLS[0] * _CELLS[1], 2), np.float32)
        if self._before is not None and self._before.shape == small.shape:
            flow = self._flow.calc(self._before, small, np.zeros((*small.shape, 2), np.float32))
            cells = cv2.resize(flow, _CELLS, interpolation=cv2.INTER_AREA)
            moved = cells.reshape(-1, 2) / np.float32(_FLOW_SIDE_PX)
        self._before = small
        return Seen(seconds, sharpness(grey), moved)


def choose(seen: Sequence[Seen], wanted: int) -> list[Chosen]:
    """Frames in order of time, at most `wanted`; 0: as many as the motion asks for."""
    path = travelled(np.array([one.moved for one in seen]))
    sharp = relative_sharpness(np.array([one.sharpness for one in seen]))
    if not wanted:
        wanted = int(np.clip(round(path[-1] / STEP), 3, MOST))
        numbers = _one_a_place(path, sharp, wanted)
    else:
        # Places without a sharp frame stay empty: more of them, until as many frames are found.
        for places in range(wanted, 3 * wanted):
            numbers = _one_a_place(path, sharp, places)
            if len(numbers) >= min(wanted, len(seen)):
                break
        kept = np.linspace(0, len(numbers) - 1, min(wanted, len(numbers))).round().astype(int)
        numbers = [numbers[i] for i in kept]
    moved = np.diff(path[numbers], prepend=path[numbers[0]])
    return [
        Chosen(n, round(seen[n].seconds, 3), round(float(sharp[n]), 3), round(float(far), 4))
        for n, far in zip(numbers, moved, strict=True)
    ]


def travelled(moved: NDArray[np.floating]) -> NDArray[np.float64]:
    """[F] how far the picture has come by each frame, of motion between frames [F, C, 2].

    Motion adds up by direction before it counts: a hand that trembles gets nowhere.
    """
    place = np.cumsum(moved, axis=0, dtype=np.float64)
    reached, far = [0], [0.0]
    for number, now in enumerate(place):
        away = float(np.linalg.norm(now - place[reached[-1]], axis=1).mean())
        if away >= _TREMBLE:
            reached.append(number)
            far.append(far[-1] + away)
    return np.interp(np.arange(len(place)), reached, far)


def relative_sharpness(sharp: NDArray[np.floating]) -> NDArray[np.float64]:
    """[F] sharpness in parts of that of the sharper frames nearby in time."""
    nearby = percentile_filter(sharp, 80, size=min(_NEARBY, len(sharp)), mode="nearest")
    return np.asarray(sharp / np.maximum(nearby, 1e-9), np.float64)


def _one_a_place(path: NDArray[np.float64], sharp: NDArray[np.float64], places: int) -> list[int]:
    """The best frame of each of `places` equal stretches of the path. A stretch of blurred frames
    gives one only where the gap would become too wide."""
    along = path / max(float(path[-1]), 1e-9) * places
    if path[-1] < _TREMBLE:
        along = np.arange(len(path)) * places / len(path)  # nothing moves: evenly in time
    place = np.minimum(along.astype(np.int64), places - 1)
    score = np.minimum(sharp, 1.0) - _OFF_CENTRE * np.abs(along - place - 0.5)
    numbers: list[int] = []
    for number in range(places):
        here = np.nonzero(place == number)[0]
        usable = here[sharp[here] >= BLURRED_BELOW]
        if (
            len(usable) == 0
            and len(here)
            and (not numbers or path[here[-1]] - path[numbers[-1]] > WIDEST_GAP)
        ):
            usable = here
        if len(usable):
            numbers.append(int(usable[np.argmax(score[usable])]))
    return numbers
