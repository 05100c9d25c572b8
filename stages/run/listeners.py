"""Several listeners of a run as one."""

from __future__ import annotations

from stages.base.stage import DrawView, Numbers, Stage
from stages.run.attempt import Listener
from stages.run.manifest import Manifest


class Listeners(Listener):
    """Forwards each event of a run to several listeners, in the order given."""

    def __init__(self, *listeners: Listener) -> None:
        self._listeners = listeners

    def started(self, stage: Stage, number: int, reason: str, resumed: bool) -> None:
        for one in self._listeners:
            one.started(stage, number, reason, resumed)

    def progressed(self, stage: Stage, label: str, done: int, total: int, numbers: Numbers) -> None:
        for one in self._listeners:
            one.progressed(stage, label, done, total, numbers)

    def drawable(self, stage: Stage, draw: DrawView) -> None:
        for one in self._listeners:
            one.drawable(stage, draw)

    def finished(self, stage: Stage, number: int, manifest: Manifest) -> None:
        for one in self._listeners:
            one.finished(stage, number, manifest)

    def skipped(self, stage: Stage, number: int, manifest: Manifest) -> None:
        for one in self._listeners:
            one.skipped(stage, number, manifest)

    def stopping(self) -> None:
        for one in self._listeners:
            one.stopping()

    def ended(self) -> None:
        for one in self._listeners:
            one.ended()
