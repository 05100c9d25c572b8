"""Child processes: they end with their parent, and how they ended is said."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import threading
from contextlib import suppress


def die_with_parent(watch_input: bool = True) -> None:
    """Make this process end when its parent does.

    On Linux the kernel ends it. Everywhere it also ends at the end of standard input, which the
    parent keeps open, unless `watch_input` is false.
    """
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG
    if watch_input:
        threading.Thread(target=_exit_at_end_of_input, daemon=True).start()


def how_it_ended(status: int) -> str:
    """ "status 1", or "signal 9 (SIGKILL)" with the likely cause, for a child's exit status, which
    is negative for a signal."""
    if status >= 0:
        return f"status {status}"
    name = ""
    with suppress(ValueError):
        name = f" ({signal.Signals(-status).name})"
    return f"signal {-status}{name}, probably because memory ran out,"


def _exit_at_end_of_input() -> None:
    while os.read(0, 4096):
        pass
    os._exit(1)
