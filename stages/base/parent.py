"""Child processes: they end with their parent, and how they ended is said."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import threading

# What the system sends where memory is short, and what libraries get that use memory they lack.
_LACK_OF_MEMORY = ("SIGKILL", "SIGSEGV", "SIGBUS")


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
    name = signal.Signals(-status).name
    cause = ", probably because memory ran out," if name in _LACK_OF_MEMORY else ""
    return f"signal {-status} ({name}){cause}"


def _exit_at_end_of_input() -> None:
    while os.read(0, 4096):
        pass
    os._exit(1)
