"""`--view`: a page on this machine that shows the scene while it is trained."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from stages.base.stage import DrawView, Numbers, Stage
from stages.base.text import quoted
from stages.page.cameras import page_cameras
from stages.run.listener import Listener
from stages.run.manifest import Manifest
from stages.run.pipeline import Pipeline
from stages.viewer.live_page import LivePage
from stages.viewer.server import LocalServer

_STAGE = "train"
_GRACE_PERIOD_S = 5.0  # for an open page to fetch the last state and the last frame
_ALL_POLL_S = 1.5  # in which each open page polls, also a hidden one, whose browser slows it down


class LiveTraining(Listener):
    """Serves the page from the start of training to the end of the run.

    Args:
        announce: called with the page's address once it is served.
        warn: called with a sentence if the page cannot be served or there is nothing to show.
    """

    def __init__(
        self, pipeline: Pipeline, announce: Callable[[str], None], warn: Callable[[str], None]
    ) -> None:
        self._pipeline = pipeline
        self._announce = announce
        self._warn = warn
        self._server: LocalServer | None = None
        self._page: LivePage | None = None

    def started(self, stage: Stage, number: int, reason: str, resumed: bool) -> None:
        if stage.name != _STAGE:
            return

        sfm, seeds = self._pipeline.load("sfm"), self._pipeline.load("seed")
        title = self._pipeline.run_folder.absolute().name
        self._page = LivePage(
            title, sfm.views, page_cameras(sfm.views, seeds), seeds.means, sfm.folder
        )
        try:
            self._server = LocalServer(self._page.items)
        except OSError as error:  # training goes on without the page
            self._warn(f"--view: no port of this machine can be listened on: {error}")
            return
        threading.Thread(target=self._server.serve_forever, daemon=True).start()
        self._announce(self._server.address)

    def progressed(self, stage: Stage, label: str, done: int, total: int, numbers: Numbers) -> None:
        if self._page is not None and stage.name == _STAGE:
            self._page.progressed(label, done, total, numbers)

    def drawable(self, stage: Stage, draw: DrawView) -> None:
        if self._page is not None:
            self._page.drawable(draw)

    def finished(self, stage: Stage, number: int, manifest: Manifest) -> None:
        if self._page is not None and stage.name == _STAGE:
            self._page.ended("finished")

    def skipped(self, stage: Stage, number: int, manifest: Manifest) -> None:
        if stage.name == _STAGE:
            self._warn(
                "--view: training had finished before, so there is nothing to watch. "
                f"See the result with: splat view {quoted(self._pipeline.run_folder)}"
            )

    def ended(self) -> None:
        if self._server is None or self._page is None:
            return
        self._page.ended("stopped")  # unless training has finished
        self._wait_for_page(self._page)
        self._server.shutdown()
        self._server.server_close()

    def _wait_for_page(self, page: LivePage) -> None:
        deadline = time.monotonic() + _GRACE_PERIOD_S
        while page.frames.is_watched() and time.monotonic() < deadline:
            # One page has the end: several may be open, and the others poll a little later.
            if page.end_delivered and time.monotonic() > page.ended_at + _ALL_POLL_S:
                break
            time.sleep(0.05)
