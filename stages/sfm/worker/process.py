"""Runs the worker process, watches it, and turns its exit status into exceptions."""

from __future__ import annotations

import re
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from threading import Event

from stages.base.disk import disk_full
from stages.base.errors import Interrupted, ReconstructionError
from stages.base.parent import end_child, how_it_ended, python_module, start_child
from stages.base.stage import Report
from stages.sfm.worker.job import Job
from stages.sfm.worker.progress import progress_path, read_progress

_POLL_SECONDS = 0.1
_TICK_SECONDS = 0.5
_TAIL_LINES = 15
_PROGRESS = re.compile(r"I\d{8} ")  # an INFO line of glog
_DISK_FULL = ("no space left on device", "database or disk is full", "disk quota exceeded")


class WorkerCrashed(ReconstructionError):  # noqa: N818 - says what happened
    """The worker ended with another status than 0 (negative for a signal).

    Args:
        step: of the job.
        status: how the worker ended.
        tail: the last lines of its log.
        log: where the whole log is.
    """

    def __init__(self, step: str, status: int, tail: str, log: Path) -> None:
        lines = [line for line in tail.splitlines() if line.strip()]
        super().__init__(
            "sfm-crashed",
            given=f"COLMAP ended with {how_it_ended(status)} during {step}. "
            f"The last line of its log: {lines[-1] if lines else '(none)'}",
            wanted="COLMAP must finish without an error.",
            hint=f"Give the same command again; if it ends the same way, use smaller photographs "
            f"(--max-side). The whole log is {log}.",
        )


class WorkerTimedOut(ReconstructionError):  # noqa: N818 - says what happened
    """The worker was killed because its time was up. photographs: how many the job has."""

    def __init__(self, photographs: int) -> None:
        super().__init__(
            "sfm-timed-out",
            given=f"Features and matches of {photographs} photographs were not finished in time.",
            wanted="Structure from motion must finish within --max-minutes.",
            hint="Allow more time with --max-minutes, or use fewer or smaller photographs "
            "(--max-side).",
        )


def run_worker(
    job: Job, folder: Path, stop: Event, max_seconds: float, tick: Callable[[], None]
) -> None:
    """Run one job to its end. The worker never outlives this call, nor this process.

    Args:
        job: what to do.
        folder: receives job.json and the worker's output, log.txt.
        stop: when it is set, the worker is killed and Interrupted raised.
        max_seconds: after this time the worker is killed and WorkerTimedOut raised.
        tick: called about twice a second meanwhile, and once at the end.

    Also raises WorkerCrashed when the worker fails, and SplatError "disk-full".
    """
    path = job.write(folder / "job.json")
    log = folder / "log.txt"
    # A BLAS with several threads may add in another order when cores are busy; COLMAP has its own
    # threads.
    environment = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    with log.open("wb") as output:
        worker = start_child(_command(path), output, environment)
        try:
            _watch(worker, job, stop, time.monotonic() + max_seconds, tick)
        finally:
            end_child(worker)
    if worker.returncode != 0:
        tail = _tail(log)
        if any(words in tail.lower() for words in _DISK_FULL):
            raise disk_full("structure from motion", folder)
        raise WorkerCrashed(job.step, worker.returncode, tail, log)
    tick()


def run_step(job: Job, folder: Path, report: Report, max_seconds: float, suffix: str = "") -> None:
    """`run_worker`, with the worker's progress passed to `report`. suffix: added to its phases."""
    unit = "pairs" if job.step in ("matching", "neighbours", "learned") else "photographs"
    progress_path(job.project.database).unlink(missing_ok=True)

    def tick() -> None:
        progress = read_progress(job.project.database)
        if progress is not None:
            phase, done, total = progress
            report.progress(done, total, phase + suffix, **{unit: done})

    run_worker(job, folder, report.stop_requested, max_seconds, tick)


def _command(job: Path) -> list[str]:
    return python_module("stages.sfm.worker", str(job))


def _watch(
    worker: subprocess.Popen[bytes],
    job: Job,
    stop: Event,
    deadline: float,
    tick: Callable[[], None],
) -> None:
    next_tick = 0.0
    while worker.poll() is None:
        if stop.is_set():
            raise Interrupted
        now = time.monotonic()
        if now > deadline:
            raise WorkerTimedOut(len(job.project.photographs))
        if now >= next_tick:
            tick()
            next_tick = now + _TICK_SECONDS
        stop.wait(_POLL_SECONDS)


def _tail(log: Path) -> str:
    lines = log.read_text(encoding="utf-8", errors="replace").splitlines()
    # COLMAP prints stack addresses after an error, which do not help a user.
    lines = [line for line in lines if not line.lstrip().startswith(("@ ", "PC: @", "***"))]
    # Other threads and processes go on printing their progress.
    errors = [line for line in lines if not _PROGRESS.match(line)]
    return "\n".join((errors or lines)[-_TAIL_LINES:])
