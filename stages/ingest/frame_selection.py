"""Selects the frames of a video to use: sharp ones, evenly spaced by the motion of the picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import percentile_filter

from stages.ingest.quality import sharpness

MEASURED_SIDE_PX = 800
_FLOW_SIDE_PX = 320
_CELLS = (6, 4)  # grid over the picture; the motion of each cell is kept for each frame
STEP = 0.05  # of the longer side, from one chosen frame to the next
FEWEST_FRAMES = 24  # of one video that moves little, as far as they differ by LEAST_STEP
LEAST_STEP = 0.015  # of the longer side
MAX_FRAMES = 300  # of one video, unless a number is given
MOST_TRIES = 50  # numbers of stretches up to twice the frames wanted
_SHAKE = 0.01  # of the longer side: motion to and fro within it is camera shake
MAX_GAP = 0.25  # of the longer side; a blurred frame is better than a wider gap
_WINDOW = 121  # frames that a frame's sharpness is compared with
BLURRED_BELOW = 0.8  # of the sharpness of the sharper frames in the window
_OFF_CENTRE = 0.2  # by how much sharper a frame at the end of its stretch must be


@dataclass(frozen=True)
class MeasuredFrame:
    """Measurements of a frame. motion [C, 2]: of the cells of the picture since the frame before,
    as a share of the longer side."""

    seconds: float
    sharpness: float
    motion: NDArray[np.float32]


@dataclass(frozen=True)
class SelectedFrame:
    """A frame to use.

    Args:
        number: in the video.
        seconds: since its start.
        sharpness: relative to the sharper frames around it.
        moved: motion since the selected frame before, as a share of the longer side.
    """

    number: int
    seconds: float
    sharpness: float
    moved: float


class FrameMeter:
    """Measures frames in order, and keeps only the one before."""

    def __init__(self) -> None:
        self._flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST)
        self._before: NDArray[np.uint8] | None = None

    def measure(self, grey: NDArray[np.uint8], seconds: float) -> MeasuredFrame:
        """grey [H, W]: the next frame, its longer side at most MEASURED_SIDE_PX."""
        scale = _FLOW_SIDE_PX / max(grey.shape)
        small = np.asarray(
            cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8
        )
        motion = np.zeros((_CELLS[0] * _CELLS[1], 2), np.float32)
        if self._before is not None and self._before.shape == small.shape:
            flow = self._flow.calc(self._before, small, np.zeros((*small.shape, 2), np.float32))
            cells = cv2.resize(flow, _CELLS, interpolation=cv2.INTER_AREA)
            motion = cells.reshape(-1, 2) / np.float32(_FLOW_SIDE_PX)
        self._before = small
        return MeasuredFrame(seconds, sharpness(grey), motion)


def select_frames(measured: Sequence[MeasuredFrame], wanted: int) -> list[SelectedFrame]:
    """Frames in order of time, at most `wanted`. With 0, one for each `STEP` of motion; a video
    that moves little gives `FEWEST_FRAMES`, as far as they are `LEAST_STEP` apart."""
    path = travelled(np.array([one.motion for one in measured]))
    sharp = relative_sharpness(np.array([one.sharpness for one in measured]))
    if not wanted:
        fewest = min(FEWEST_FRAMES, int(path[-1] / LEAST_STEP))
        wanted = int(np.clip(max(round(path[-1] / STEP), fewest), 3, MAX_FRAMES))
        numbers = _one_per_stretch(path, sharp, wanted)
    else:
        # Stretches without a sharp frame give none: try more of them until there are enough frames.
        wanted, numbers = min(wanted, len(measured)), []
        for places in range(wanted, 3 * wanted, max(1, wanted // MOST_TRIES)):
            numbers = max(numbers, _one_per_stretch(path, sharp, places), key=len)
            if len(numbers) >= wanted:
                break
        kept = np.linspace(0, len(numbers) - 1, min(wanted, len(numbers))).round().astype(int)
        numbers = [numbers[i] for i in kept]
    moved = np.diff(path[numbers], prepend=path[numbers[0]])
    return [
        SelectedFrame(
            n, round(measured[n].seconds, 3), round(float(sharp[n]), 3), round(float(far), 4)
        )
        for n, far in zip(numbers, moved, strict=True)
    ]


def travelled(moved: NDArray[np.floating]) -> NDArray[np.float64]:
    """[F] how far the picture has moved by each frame, from the motion between frames [F, C, 2].

    Motion is summed with its direction before it counts, so that camera shake does not add up.
    """
    position = np.cumsum(moved, axis=0, dtype=np.float64)
    reached, distance = [0], [0.0]
    for number, now in enumerate(position):
        away = float(np.linalg.norm(now - position[reached[-1]], axis=1).mean())
        if away >= _SHAKE:
            reached.append(number)
            distance.append(distance[-1] + away)
    return np.interp(np.arange(len(position)), reached, distance)


def relative_sharpness(sharp: NDArray[np.floating]) -> NDArray[np.float64]:
    """[F] sharpness relative to the sharper frames around each in time."""
    nearby = percentile_filter(sharp, 80, size=min(_WINDOW, len(sharp)), mode="nearest")
    return np.asarray(sharp / np.maximum(nearby, 1e-9), np.float64)


def _one_per_stretch(
    path: NDArray[np.float64], sharp: NDArray[np.float64], places: int
) -> list[int]:
    """The best frame of each of `places` equal stretches of the path. A stretch of blurred frames
    gives one only if the gap would be too wide without it."""
    along = path / max(float(path[-1]), 1e-9) * places
    if path[-1] < _SHAKE:
        along = np.arange(len(path)) * places / len(path)  # nothing moves: evenly spaced in time
    place = np.minimum(along.astype(np.int64), places - 1)
    score = np.minimum(sharp, 1.0) - _OFF_CENTRE * np.abs(along - place - 0.5)
    numbers: list[int] = []
    for number in range(places):
        here = np.nonzero(place == number)[0]
        usable = here[sharp[here] >= BLURRED_BELOW]
        if (
            len(usable) == 0
            and len(here)
            and (not numbers or path[here[-1]] - path[numbers[-1]] > MAX_GAP)
        ):
            usable = here
        if len(usable):
            numbers.append(int(usable[np.argmax(score[usable])]))
    return numbers
