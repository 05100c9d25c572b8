"""The page that shows a scene while it is trained: the addresses behind it.

The page holds the camera; a picture is asked for with a place and drawn by the trainer itself, so
that it shows what is being trained, to the last bit of view-dependent colour.
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

from stages.base.stage import Numbers
from stages.formats.page import document
from stages.formats.page.cameras import PageCamera
from stages.scene import Camera, View
from stages.scene.framing import median_depth
from stages.viewer.live_frames import Picture, Pictures
from stages.viewer.server import Answer, Item
from stages.viewer.site import with_photographs

SIDES = (16, 1280)  # pixels of a picture's longer side
PATIENCE_S = 10.0
JPEG_QUALITY = 92  # no visible blocks; about 100 kB at 640 px


class LivePage:
    """items: what to serve. pictures: where the trainer offers them. told: whether a browser has
    heard of the end, and has the last picture.

    views: the capture's cameras. photos: the folder that `View.image` starts from. points [N, 3]:
    something of the scene, for the distance to turn around.
    """

    def __init__(
        self,
        title: str,
        views: Sequence[View],
        shots: Sequence[PageCamera],
        points: NDArray[np.floating],
        photos: Path | None = None,
    ) -> None:
        self.pictures = Pictures()
        self.told = self._end_told = False
        self._cameras = [shot.camera for shot in shots]
        self._state: dict[str, Any] = {"phase": "", "done": 0, "total": 0, "end": ""}
        self._start, self._first = time.monotonic(), 0
        shown, photographs = with_photographs(shots, views, photos)
        scene = {"title": title, "shots": [_plain(shot, points) for shot in shown]}
        page = document.live(scene).encode("utf-8")
        self.items: dict[str, Item | Answer] = {
            **photographs,
            "/": Item(page, "text/html; charset=utf-8"),
            "/state": self._answer_state,
            "/picture": self._answer_picture,
        }

    def progressed(self, label: str, done: int, total: int, numbers: Numbers) -> None:
        """Take note of how far training is."""
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

    def ended(self, how: str) -> None:
        """how: "finished" or "stopped". The page hears of it when it next asks."""
        self.pictures.close()
        self._state = {**self._state, "end": how}

    def _answer_state(self, query: dict[str, str]) -> Item:
        self.pictures.looked()
        state = self._state
        self._end_told = state["end"] != ""
        spent = state.get("spent_s", 0.0)
        share = self.pictures.seconds / spent if spent else 0.0
        return _json({**state, "drawing_share": share})

    def _answer_picture(self, query: dict[str, str]) -> Item:
        """shot: number of the camera whose lens is used. side: longer side in pixels. place:
        12 numbers, the upper rows of world_to_camera."""
        number, side = int(query.get("shot", "")), int(query.get("side", ""))
        if not (0 <= number < len(self._cameras) and SIDES[0] <= side <= SIDES[1]):
            raise ValueError(f"shot {number}, side {side}")
        place = _rigid(query.get("place", ""))
        camera = replace(self._cameras[number].fitted(side), world_to_camera=place)
        last = self._end_told
        picture = self.pictures.ask(camera, PATIENCE_S)
        self.told = last
        return _json({} if picture is None else _as_data(picture))


def _rigid(text: str) -> NDArray[np.float64]:
    """[4, 4] from 12 numbers; rounding in the page is no matter. Raises ValueError."""
    rows = np.array([float(word) for word in text.split(",")]).reshape(3, 4)
    rotation = rows[:, :3]
    if not (np.isfinite(rows).all() and np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3)):
        raise ValueError("not a place to look from")
    return np.vstack([rows, [0.0, 0.0, 0.0, 1.0]])


def _plain(shot: PageCamera, points: NDArray[np.floating]) -> dict[str, Any]:
    """A shot as the page takes it. depth: how far ahead the point to turn around lies."""
    camera: Camera = shot.camera
    return {
        "name": shot.name,
        "photo": shot.photo,
        "held_out": shot.held_out,
        **{name: getattr(camera, name) for name in ("width", "height", "fx")},
        "place": camera.world_to_camera[:3].ravel().tolist(),
        "depth": median_depth(camera, points),
    }


def _as_data(picture: Picture) -> dict[str, Any]:
    from PIL import Image

    file = BytesIO()
    Image.fromarray(picture.pixels).save(file, "JPEG", quality=JPEG_QUALITY, subsampling=0)
    text = base64.b64encode(file.getvalue()).decode("ascii")
    jpeg = f"data:image/jpeg;base64,{text}"
    return {"jpeg": jpeg, "step": picture.step, "seconds": picture.seconds}


def _json(data: dict[str, Any]) -> Item:
    return Item(json.dumps(data, allow_nan=False).encode("utf-8"), "application/json")
