"""Several listeners of a run as one."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from stages.run.attempt import Listener


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
