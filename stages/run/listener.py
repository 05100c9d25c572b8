"""Receives the events of a run: one listener, or several in turn."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from stages.base.stage import DrawView, Numbers, Stage
from stages.run.manifest import Manifest


class Listener:
    """Receives the events of a run. Subclasses override the methods that they need."""

    def started(self, stage: Stage, number: int, reason: str, resumed: bool) -> None:
        """`resumed`: an interrupted attempt at the same request is continued."""

    def progressed(self, stage: Stage, label: str, done: int, total: int, numbers: Numbers) -> None:
        """As `Report.progress`."""

    def drawable(self, stage: Stage, draw: DrawView) -> None:
        """As `Report.offer`: the work so far can be drawn."""

    def finished(self, stage: Stage, number: int, manifest: Manifest) -> None:
        """The stage ran, and its output is final."""

    def skipped(self, stage: Stage, number: int, manifest: Manifest) -> None:
        """The stage was finished before, and nothing changed."""

    def stopping(self) -> None:
        """A signal requested a stop; the run stops at the next safe boundary."""

    def ended(self) -> None:
        """The run is over, whether it succeeded or not."""


class Listeners(Listener):
    """Passes each event of a run on to several listeners, in the order given."""

    def __init__(self, *listeners: Listener) -> None:
        for event in vars(Listener):
            if not event.startswith("_"):
                setattr(self, event, _every([getattr(one, event) for one in listeners]))


def _every(methods: list[Callable[..., None]]) -> Callable[..., None]:
    def call(*values: Any) -> None:
        for method in methods:
            method(*values)

    return call
