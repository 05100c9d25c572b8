"""Runs the command in a child process, so that its end by a signal is reported as an error.

The system ends a process that uses too much memory, and libraries crash where memory runs out.
Then the process itself can say nothing.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable
from types import FrameType

from splatcli import console
from stages.base.errors import ResourceError, SplatError
from stages.base.parent import die_with_parent, how_it_ended

_FORWARDED = ("SIGINT", "SIGTERM", "SIGHUP", "SIGCONT")


def watched(command: Callable[[], None]) -> None:
    """Run `command` in a child process, pass signals on to it, and exit with its status. Where
    processes cannot fork, `command` runs in this one."""
    if not hasattr(os, "fork"):
        return command()
    forwarded = {getattr(signal, name) for name in _FORWARDED}
    # A signal that arrives before it can be forwarded waits until then.
    signal.pthread_sigmask(signal.SIG_BLOCK, forwarded)
    child = os.fork()
    if child == 0:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, forwarded)
        # In a group of its own, so that a terminal's Ctrl-C reaches it once, from the parent.
        os.setpgid(0, 0)
        signal.signal(signal.SIGTTOU, signal.SIG_IGN)  # it may write to the terminal all the same
        die_with_parent(watch_input=False)
        return command()
    _forward_signals(child)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, forwarded)
    status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    if status < 0 and -status not in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        console.mode.as_json = "--json" in sys.argv
        status = console.show_error(_crashed(status))
    elif status < 0:  # end as it did
        signal.signal(-status, signal.SIG_DFL)
        os.kill(os.getpid(), -status)
    os._exit(status)


def _forward_signals(child: int) -> None:
    def forward(number: int, frame: FrameType | None) -> None:
        os.kill(child, number)

    def pause(number: int, frame: FrameType | None) -> None:
        os.kill(child, signal.SIGSTOP)
        os.kill(os.getpid(), signal.SIGSTOP)

    for name in _FORWARDED:
        signal.signal(getattr(signal, name), forward)
    signal.signal(signal.SIGTSTP, pause)


def _crashed(status: int) -> SplatError:
    return ResourceError(
        "command-crashed",
        given=f"splat was ended by {how_it_ended(status)} and could not finish.",
        wanted="Enough free memory, also where `ulimit -v` or a container limits it.",
        hint="Free memory, or ask for less (--max-splats, --train-side, --max-side), and give the "
        "same command again: what was finished is kept.",
    )
