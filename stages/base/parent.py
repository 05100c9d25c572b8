"""A helper process that must not outlive who started it."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import threading


def die_with_parent() -> None:
    """End when the parent does: by the kernel on Linux, and everywhere when standard input, which
    the parent holds open, comes to its end."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG
    threading.Thread(target=_exit_at_end_of_input, daemon=True).start()


def _exit_at_end_of_input() -> None:
    while os.read(0, 4096):
        pass
    os._exit(1)
