"""Web engines that we did not write draw our files in a headless browser."""

from __future__ import annotations

import functools
import json
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np

from stages.proof.checks import read_back
from stages.scene import Camera
from tests.viewer.browser import Browser

PAGES = Path(__file__).parent / "pages"
# What each engine reads (their documentation, and tried).
ENGINES = {
    "playcanvas": ("ply", "glb", "quantised.glb", "gltf", "compressed.ply", "sog"),
    "three": ("glb", "quantised.glb", "gltf"),
    "spark": ("ply", "splat", "compressed.ply", "spz", "sog"),
}
NEAR, FAR = 0.01, 1000.0
_PATIENCE_S = 120
# How long a picture must stay as it is: a sort that is under way has ended by then.
_REST_S, _REST_FRAMES = 2.0, 5


class _Handler(SimpleHTTPRequestHandler):
    """/node_modules/ from the packages, /files/ from the exports, / from the pages."""

    def __init__(self, *request: Any, roots: dict[str, Path], **more: Any) -> None:
        self.roots = roots
        super().__init__(*request, **more)

    def translate_path(self, path: str) -> str:
        first = path.split("/")[1]
        self.directory = str(self.roots.get(first, PAGES))
        rest = path.removeprefix(f"/{first}") if first in self.roots else path
        return super().translate_path(rest)

    def log_message(self, *ignored: Any) -> None:
        pass


@contextmanager
def served(packages: Path, files: Path) -> Iterator[str]:
    roots = {"node_modules": packages, "files": files}
    handler = functools.partial(_Handler, roots=roots)
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}/"
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


def view_of(camera: Camera) -> dict[str, Any]:
    """The same camera in OpenGL's terms: x right, y up, z back; matrices in columns."""
    world_from_view = np.linalg.inv(camera.world_to_camera) @ np.diag([1.0, -1.0, -1.0, 1.0])
    projection = np.zeros((4, 4))
    projection[0, 0] = 2 * camera.fx / camera.width
    projection[0, 2] = 1 - 2 * camera.cx / camera.width
    projection[1, 1] = 2 * camera.fy / camera.height
    projection[1, 2] = 2 * camera.cy / camera.height - 1
    projection[2, 2] = -(FAR + NEAR) / (FAR - NEAR)
    projection[2, 3] = -2 * FAR * NEAR / (FAR - NEAR)
    projection[3, 2] = -1
    return {
        "worldFromView": world_from_view.T.ravel().tolist(),
        "projection": projection.T.ravel().tolist(),
    }


class Engine:
    """One engine in one browser page."""

    def __init__(self, browser: Browser, address: str, name: str) -> None:
        browser.said.clear()
        self.browser = browser
        browser.open(f"{address}index.html?engine={name}")
        deadline = time.monotonic() + _PATIENCE_S
        while not browser.run("'splatOpen' in window"):
            assert not browser.said, browser.said
            assert time.monotonic() < deadline, "the engine never loaded"
            time.sleep(0.1)

    def open(self, name: str) -> int:
        """Load a served file; how many splats the engine says it has."""
        count: int = self.browser.run(f"splatOpen({json.dumps('/files/' + name)})")
        return count

    def draw(self, camera: Camera) -> np.ndarray:
        """[H, W, 3] what the page shows from `camera`, which stands in the file's axes.

        Engines sort in a thread of their own: waited for until the picture stays as it is.
        """
        self.browser.run(f"splatLook({json.dumps(view_of(camera))})")
        deadline = time.monotonic() + _PATIENCE_S
        last, since, frames = self.browser.picture(), time.monotonic(), 0
        while time.monotonic() < deadline:
            self.browser.run("splatFrames(2)")
            picture = self.browser.picture()
            if not picture.any() or not np.array_equal(picture, last):
                last, since, frames = picture, time.monotonic(), 0
            frames += 2
            if frames > _REST_FRAMES and time.monotonic() - since > _REST_S:
                return picture
        raise AssertionError(f"the picture never came to rest; the page said {self.browser.said}")


def camera_for(path: Path, camera: Camera) -> Camera:
    """A camera of our world in the axes of a file: no engine here turns what it loads."""
    return camera.moved(read_back(path).world_from_file)
