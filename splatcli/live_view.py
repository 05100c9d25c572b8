"""`--view`: a page on this machine that shows the scene while it is trained."""

from __future__ import annotations

import shlex
import threading
import time
from typing import TYPE_CHECKING

from splatcli import console
from splatcli.commands.view import open_page
from stages.base.stage import DrawView, Numbers, Stage
from stages.run.manifest import Manifest
from stages.run.pipeline import Listener, Pipeline

if TYPE_CHECKING:
    from stages.viewer.live_page import LivePage
    from stages.viewer.server import LocalServer

WATCHED = "train"
_FAREWELL_S = 5.0  # for an open page to hear how it ended; it asks twice a second, a busy one less


class LiveTraining(Listener):
    """Serves the page from the start of training to the end of the run."""

    def __init__(self, pipeline: Pipeline, as_json: bool) -> None:
        self._pipeline = pipeline
        self._as_json = as_json
        self._server: LocalServer | None = None
        self._page: LivePage | None = None
        self._end = "stopped"
        self._progress = (0, 0)

    def started(self, stage: Stage, number: int, reason: str, resumed: bool) -> None:
        if stage.name != WATCHED:
            return
        from stages.formats.page.cameras import page_cameras
        from stages.viewer.live_page import LivePage
        from stages.viewer.server import LocalServer

        sfm, seeds = self._pipeline.load("sfm"), self._pipeline.load("seed")
        title = self._pipeline.run_folder.absolute().name
        self._page = LivePage(
            title, sfm.views, page_cameras(sfm.views, seeds), seeds.means, sfm.folder
        )
        try:
            self._server = LocalServer(self._page.items)
        except OSError as error:  # looking on is no reason not to train
            console.note(f"--view: no port of this machine can be listened on: {error}", "yellow")
            return
        threading.Thread(target=self._server.serve_forever, daemon=True).start()
        self._announce(self._server.address)

    def _announce(self, address: str) -> None:
        if self._as_json:
            console.emit("view", address=address)
        else:
            console.note(f"Watch it train at {address}", "bold")
        open_page(address)

    def progressed(self, stage: Stage, label: str, done: int, total: int, numbers: Numbers) -> None:
        if self._page is not None and stage.name == WATCHED:
            self._progress = (done, total)
            self._page.progressed(label, done, total, numbers)

    def drawable(self, stage: Stage, draw: DrawView) -> None:
        if self._page is None:
            return
        done, total = self._progress
        if done < total:
            self._page.pictures.offer(draw, done)
        else:
            self._page.pictures.offer_last(draw, done)

    def finished(self, stage: Stage, number: int, manifest: Manifest) -> None:
        if self._page is not None and stage.name == WATCHED:
            self._end = "finished"
            self._page.ended(self._end)

    def skipped(self, stage: Stage, number: int, manifest: Manifest) -> None:
        if stage.name == WATCHED:
            look = shlex.join(["splat", "view", str(self._pipeline.run_folder)])
            what = "Training was finished before: there is nothing to watch."
            console.note(f"{what} Look at the result with: {look}")

    def ended(self) -> None:
        if self._server is None or self._page is None:
            return
        if self._end == "stopped":
            self._page.ended(self._end)
        self._wait_for_the_page(self._page)
        self._server.shutdown()
        self._server.server_close()

    def _wait_for_the_page(self, page: LivePage) -> None:
        deadline = time.monotonic() + _FAREWELL_S
        while page.pictures.watched() and not page.told and time.monotonic() < deadline:
            time.sleep(0.05)
