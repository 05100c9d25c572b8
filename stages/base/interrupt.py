"""Ctrl-C requests a stop at the next safe boundary; a second Ctrl-C stops at once."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from types import FrameType


def signals(*names: str) -> list[signal.Signals]:
    """The signals of these names; names that the system does not have are left out."""
    return [getattr(signal, name) for name in names if hasattr(signal, name)]


@contextmanager
def handling(
    numbers: Sequence[int], handle: Callable[[int, FrameType | None], None]
) -> Iterator[None]:
    """Inside the block, `handle` receives these signals. Outside the main thread nothing is
    changed."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, handle) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def stop_event(
    given: threading.Event | None, on_stop: Callable[[], None]
) -> Iterator[threading.Event]:
    """Yield the given event, which its owner sets, or one that signals set: `stop_on_signals`."""
    stop = given or threading.Event()
    with nullcontext() if given else stop_on_signals(stop, on_stop):
        yield stop


@contextmanager
def stop_on_signals(stop: threading.Event, on_stop: Callable[[], None]) -> Iterator[None]:
    """The first SIGINT or SIGTERM sets `stop` and calls `on_stop`; the second raises
    KeyboardInterrupt; a third ends the process. Outside the main thread nothing is changed.
    """

    def handle(number: int, frame: FrameType | None) -> None:
        if stop.is_set():
            signal.signal(number, signal.SIG_DFL)
            raise KeyboardInterrupt
        stop.set()
        on_stop()

    with handling(signals("SIGINT", "SIGTERM"), handle):
        yield
