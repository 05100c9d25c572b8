"""Free memory, and the peak memory of one stage.

`ru_maxrss` is the peak of the whole process since it started, so a stage would inherit the peak of
the one before. Linux can reset its own record of the peak (proc(5): writing 5 to clear_refs);
elsewhere the peak is the largest of regular samples. Child processes are always sampled.

psutil is imported at first use: `splat --help` does not wait for it.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import psutil

from stages.base import cgroups

MIB = 1024.0 * 1024.0
_TRAINING_BYTES = 1600  # a splat
_SELF = Path("/proc/self")


def available_mib() -> float:
    """Memory that can be allocated without swapping, within a container's limit, MiB."""
    return min(float(psutil.virtual_memory().available), cgroups.free_bytes()) / MIB


def training_mib(splats: int) -> float:
    """Memory that `splats` splats take in training: parameters, moments, gradients, footprint and
    about 6 intersections. Drawing them takes half of it."""
    return splats * _TRAINING_BYTES / MIB


def resident_mib(pid: int | None = None) -> float:
    """Resident memory of a process (by default this one), MiB; 0 if it has ended."""
    try:
        return float(psutil.Process(pid).memory_info().rss) / MIB
    except psutil.Error:
        return 0.0


def descendants(pid: int | None = None) -> list[int]:
    """Process ids of the children of a process (by default this one), their children and so on."""
    try:
        return [child.pid for child in psutil.Process(pid).children(recursive=True)]
    except psutil.Error:
        return []


class PeakMemory:
    """Context manager that measures peak memory.

    `peak_mib` is the largest resident memory of this process and its descendants together between
    entry and exit, MiB.

    Args:
        interval_s: time between samples, seconds.
        tick: called with the peak so far after each sample, on the sampling thread.
    """

    def __init__(
        self, interval_s: float = 0.2, tick: Callable[[float], None] | None = None
    ) -> None:
        self.peak_mib = 0.0
        self._interval_s = interval_s
        self._tick = tick
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="peak-memory", daemon=True)

    def __enter__(self) -> PeakMemory:
        self._was_reset = _reset_peak()
        self._thread.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._ended.set()
        self._thread.join()
        self._sample()
        if self._was_reset:
            self.peak_mib = max(self.peak_mib, _peak_since_reset_mib())

    def _watch(self) -> None:
        while not self._ended.wait(self._interval_s):
            self._sample()
            if self._tick is not None:
                self._tick(self.peak_mib)

    def _sample(self) -> None:
        now = resident_mib() + sum(map(resident_mib, descendants()))
        self.peak_mib = max(self.peak_mib, now)


def _reset_peak() -> bool:
    """Reset the kernel's record of this process's peak. False where there is no such thing."""
    try:
        (_SELF / "clear_refs").write_text("5")
        return True
    except OSError:
        return False


def _peak_since_reset_mib() -> float:
    with suppress(OSError, ValueError):
        for line in (_SELF / "status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) / 1024.0
    return 0.0
