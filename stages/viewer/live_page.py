"""The page that shows a scene while it is trained, and the addresses that it requests.

The page holds the camera. It requests a frame with a pose, and the trainer itself draws it, so that
the frame shows the splats in training with their view-dependent colour.

Also: frames of a training scene on request, drawn by the training thread itself.

Requests wait in threads of their own; the training thread never waits. It draws between two steps,
where no kernel is running, one frame at a time.
"""

from __future__ import annotations

import base64
import json
import queue
import time
from collections.abc import Callable, Sequence
from concurrent.futures import CancelledError, Future
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from stages.base.errors import SplatError
from stages.base.stage import DrawView, Numbers
from stages.page import document
from stages.page.cameras import PageCamera
from stages.scene import Camera, View
from stages.scene.framing import median_depth
from stages.viewer.server import Item, Response
from stages.viewer.site import with_photographs

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


SIDES = (16, 1280)  # shortest and longest allowed longer side of a frame, pixels
TIMEOUT_S = 10.0
JPEG_QUALITY = 92  # no visible blocks; about 100 kB at 640 px


class LivePage:
    """The content of the page.

    Attributes: `items`, what to serve by address; `frames`, where the trainer offers to draw;
    `end_delivered`, whether a browser has received the end and the last frame.

    Args:
        views: the capture's views.
        shots: the cameras that the page lists.
        points: [N, 3] of the scene; their median depth is the distance to orbit at.
        photos: the folder that `View.image` starts from.
    """

    def __init__(
        self,
        title: str,
        views: Sequence[View],
        shots: Sequence[PageCamera],
        points: NDArray[np.floating],
        photos: Path | None = None,
    ) -> None:
        self.frames = LiveFrames()
        self.end_delivered = self._end_requested = False
        self._cameras = [shot.camera for shot in shots]
        self._state: dict[str, Any] = {"phase": "", "done": 0, "total": 0, "end": ""}
        self._start, self._first = time.monotonic(), 0
        shown, photographs = with_photographs(shots, views, photos)
        scene = {"title": title, "shots": [_plain(shot, points) for shot in shown]}
        page = document.live(scene).encode("utf-8")
        self.items: dict[str, Item | Response] = {
            **photographs,
            "/": Item(page, "text/html; charset=utf-8"),
            "/state": self._answer_state,
            "/picture": self._answer_picture,
        }

    def progressed(self, label: str, done: int, total: int, numbers: Numbers) -> None:
        """Note the progress of training."""
        now = time.monotonic()
        if label != self._state["phase"]:
            self._first, self._start = done, now
        spent, new = now - self._start, done - self._first
        self._state = {
            "phase": label,
            "done": done,
            "total": total,
            "spent_s": spent,
            "left_s": spent / new * (total - done) if new > 0 else None,
            "numbers": {k: v for k, v in numbers.items() if isinstance(v, str) or np.isfinite(v)},
            "end": "",
        }

    def drawable(self, draw: DrawView) -> None:
        """Training can draw a frame; after its last step it draws the one that is kept."""
        done = self._state["done"]
        if done < self._state["total"]:
            self.frames.offer(draw, done)
        else:
            self.frames.offer_last(draw, done)

    def ended(self, how: str) -> None:
        """how: "finished" or "stopped", of which the first counts. The page gets it with its next
        request for the state."""
        self.frames.close()
        self._state = {**self._state, "end": self._state["end"] or how}

    def _answer_state(self, query: dict[str, str]) -> Item:
        self.frames.mark_watched()
        state = self._state
        self._end_requested = state["end"] != ""
        spent = state.get("spent_s", 0.0)
        share = self.frames.seconds / spent if spent else 0.0
        return _json({**state, "drawing_share": share})

    def _answer_picture(self, query: dict[str, str]) -> Item:
        """A frame. Its query has `shot`, the number of the camera whose intrinsics are used;
        `side`, the longer side in pixels; `place`, the 12 numbers of the upper three rows of
        world_to_camera. Raises ValueError."""
        number, side = int(query.get("shot", "")), int(query.get("side", ""))
        if not (0 <= number < len(self._cameras) and SIDES[0] <= side <= SIDES[1]):
            raise ValueError(f"shot {number}, side {side}")
        place = _rigid(query.get("place", ""))
        camera = replace(self._cameras[number].fitted(side), world_to_camera=place)
        last = self._end_requested
        frame = self.frames.request(camera, TIMEOUT_S)
        self.end_delivered = last
        return _json({} if frame is None else _encoded(frame))


def _rigid(text: str) -> NDArray[np.float64]:
    """[4, 4] world_to_camera from 12 numbers, rounded by the page. Raises ValueError if they are no
    rigid transform."""
    rows = np.array([float(word) for word in text.split(",")]).reshape(3, 4)
    rotation = rows[:, :3]
    if not (np.isfinite(rows).all() and np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3)):
        raise ValueError("not a rigid transform")
    return np.vstack([rows, [0.0, 0.0, 0.0, 1.0]])


def _plain(shot: PageCamera, points: NDArray[np.floating]) -> dict[str, Any]:
    """A shot as the page reads it. `depth`: the distance to the point that the page orbits."""
    camera: Camera = shot.camera
    return {
        "name": shot.name,
        "photo": shot.photo,
        "held_out": shot.held_out,
        **{name: getattr(camera, name) for name in ("width", "height", "fx")},
        "place": camera.world_to_camera[:3].ravel().tolist(),
        "depth": median_depth(camera, points),
    }


def _encoded(frame: Frame) -> dict[str, Any]:
    file = BytesIO()
    Image.fromarray(frame.pixels).save(file, "JPEG", quality=JPEG_QUALITY, subsampling=0)
    text = base64.b64encode(file.getvalue()).decode("ascii")
    jpeg = f"data:image/jpeg;base64,{text}"
    return {"jpeg": jpeg, "step": frame.step, "seconds": frame.seconds}


def _json(data: dict[str, Any]) -> Item:
    return Item(json.dumps(data, allow_nan=False).encode("utf-8"), "application/json")
