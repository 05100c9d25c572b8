"""The page that shows a scene while it is trained, and the addresses that it requests.

The page holds the camera. It requests a frame with a pose, and the trainer itself draws it, so that
the frame shows the splats in training with their view-dependent colour.
"""

from __future__ import annotations

import base64
import json
import time
from collections.abc import Sequence
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from stages.base.stage import DrawView, Numbers
from stages.page import document
from stages.page.cameras import PageCamera
from stages.scene import Camera, View
from stages.scene.framing import median_depth
from stages.viewer.live_frames import Frame, LiveFrames
from stages.viewer.server import Item, Response
from stages.viewer.site import with_photographs

SIDES = (16, 1280)  # shortest and longest allowed longer side of a frame, pixels
TIMEOUT_S = 10.0
JPEG_QUALITY = 92  # no visible blocks; about 100 kB at 640 px


class LivePage:
    """The content of the page.

    Attributes: `items`, what to serve by address; `frames`, where the trainer offers to draw;
    `end_delivered`, whether a browser has received the end and the last frame; `ended_at`, when
    the end was noted, by `time.monotonic`.

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
        self.ended_at = np.inf
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
        """how: "finished" or "stopped"; only the first call counts. The page gets it with its next
        request for the state."""
        self.frames.close()
        self.ended_at = min(self.ended_at, time.monotonic())
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
