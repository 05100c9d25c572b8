"""Child processes: start them so that they end with their parent, and describe how they ended."""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

# What the system sends where memory is short, and what libraries get that use memory they lack.
_LACK_OF_MEMORY = ("SIGKILL", "SIGSEGV", "SIGBUS")


def python_module(name: str, *arguments: str) -> list[str]:
    """The command that runs a module of the project.

    -P: modules in the current folder, such as a file named `numpy.py`, must not be imported."""
    return [sys.executable, "-P", "-m", name, *arguments]


def start_child(
    command: list[str], output: Any, environment: Mapping[str, str] | None = None
) -> subprocess.Popen[bytes]:
    """Start a process that finds the project's modules.

    It ends when its input does, if it calls `die_with_parent`. It is in a session of its own, so
    that Ctrl-C reaches this process alone. output: for both of its outputs, as `Popen` has it.
    """
    root = str(Path(__file__).resolve().parents[2])
    paths = os.pathsep.join([root, *filter(None, [os.environ.get("PYTHONPATH")])])
    return subprocess.Popen(
        command,
        stdin=subprocess.PIPE,
        stdout=output,
        stderr=output,
        env={**os.environ, **(environment or {}), "PYTHONPATH": paths},
        start_new_session=True,
    )


def end_child(child: subprocess.Popen[bytes]) -> None:
    """Kill a process of `start_child`, unless it has ended."""
    child.kill()
    child.wait()
    if child.stdin is not None:
        child.stdin.close()


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
