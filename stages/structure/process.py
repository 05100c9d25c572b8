"""Runs the worker process, watches it, and turns its end into something that can be handled."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from threading import Event

from stages.base.errors import Family, Interrupted, SplatError
from stages.structure.job import Job

_POLL_SECONDS = 0.1
_TICK_SECONDS = 0.5
_TAIL_LINES = 15
_PROGRESS = re.compile(r"I\d{8} ")  # a line of glog at the level of information
_DISK_FULL = ("no space left on device", "database or disk is full", "disk quota exceeded")


class WorkerCrashed(Exception):  # noqa: N818 - says what happened
    """The worker ended with another status than 0. status: negative for a signal."""

    def __init__(self, step: str, status: int, tail: str) -> None:
        super().__init__(f"{step} ended with status {status}:\n{tail}")
        self.step, self.status, self.tail = step, status, tail


class WorkerTimedOut(Exception):  # noqa: N818 - says what happened
    """The worker was ended because its time was over."""


def run_worker(
    job: Job, folder: Path, stop: Event, max_seconds: float, tick: Callable[[], None]
) -> None:
    """Run one job to its end; `tick` is called about twice a second meanwhile.

    The worker's words go to `folder`/log.txt. Raises Interrupted when `stop` is set,
    WorkerTimedOut after `max_seconds`, WorkerCrashed when the worker fails, and SplatError
    "disk-full". The worker never outlives this call, nor this process.
    """
    path = job.write(folder / "job.json")
    log = folder / "log.txt"
    root = str(Path(__file__).resolve().parents[2])
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join([root, *filter(None, [os.environ.get("PYTHONPATH")])])
    }
    # A BLAS of several threads may add up in another order when its cores are busy; COLMAP has
    # threads of its own.
    environment |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    with log.open("wb") as output:
        # A session of its own: Ctrl-C goes to the parent alone, which then decides.
        worker = subprocess.Popen(
            _command(path),
            stdin=subprocess.PIPE,
            stdout=output,
            stderr=subprocess.STDOUT,
            env=environment,
            start_new_session=True,
        )
        try:
            _watch(worker, stop, time.monotonic() + max_seconds, tick)
        finally:
            worker.kill()
            worker.wait()
            if worker.stdin is not None:
                worker.stdin.close()
    if worker.returncode != 0:
        tail = _tail(log)
        if any(words in tail.lower() for words in _DISK_FULL):
            raise _disk_full(folder)
        raise WorkerCrashed(job.step, worker.returncode, tail)
    tick()


def _command(job: Path) -> list[str]:
    # -P: the current folder may hold anything, also photographs beside a file named numpy.py.
    return [sys.executable, "-P", "-m", "stages.structure.worker", str(job)]


def _watch(
    worker: subprocess.Popen[bytes], stop: Event, deadline: float, tick: Callable[[], None]
) -> None:
    next_tick = 0.0
    while worker.poll() is None:
        if stop.is_set():
            raise Interrupted
        now = time.monotonic()
        if now > deadline:
            raise WorkerTimedOut
        if now >= next_tick:
            tick()
            next_tick = now + _TICK_SECONDS
        stop.wait(_POLL_SECONDS)


def _tail(log: Path) -> str:
    lines = log.read_text(encoding="utf-8", errors="replace").splitlines()
    # COLMAP follows what went wrong by the addresses of its stack, which tell a user nothing.
    lines = [line for line in lines if not line.lstrip().startswith(("@ ", "PC: @", "***"))]
    # Other threads and processes go on saying how far they are.
    telling = [line for line in lines if not _PROGRESS.match(line)]
    return "\n".join((telling or lines)[-_TAIL_LINES:])


def _disk_full(folder: Path) -> SplatError:
    return SplatError(
        "disk-full",
        given=f"The disk of {folder} became full during structure from motion.",
        wanted="About 10 MB a photograph are needed while it works.",
        hint="Free some space and give the same command again: finished work is kept.",
        family=Family.RESOURCES,
    )


def crash_error(crash: WorkerCrashed, folder: Path) -> SplatError:
    """A worker's crash as an error for the user; the log stays in `folder`."""
    lines = [line for line in crash.tail.splitlines() if line.strip()]
    last = lines[-1] if lines else "it said nothing"
    how = f"signal {-crash.status}" if crash.status < 0 else f"status {crash.status}"
    return SplatError(
        "sfm-crashed",
        given=f"COLMAP ended with {how} during {crash.step}. Its last words: {last}",
        wanted="It should have come to its end.",
        hint=f"Give the same command again; if it ends the same way, use smaller photographs "
        f"(--max-side). The whole log is {folder / 'log.txt'}.",
        family=Family.RECONSTRUCTION,
    )
