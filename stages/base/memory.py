"""Peak memory of one stage.

`ru_maxrss` is the peak of the whole process since it started, so the second stage would inherit
the first one's. Linux can forget the peak (proc(5): writing 5 to clear_refs) and tells the present
size; what child processes hold is sampled. Elsewhere the process's peak so far has to do.
"""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from types import TracebackType

MIB = 1024.0 * 1024.0
_PROC = Path("/proc")


def available_mib() -> float | None:
    """Memory that can be had without swapping, MiB; None where the system does not say."""
    try:
        for line in (_PROC / "meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) / 1024.0
    except (OSError, ValueError):
        pass
    return None


def resident_mib(pid: int | str = "self") -> float:
    """Resident memory of one process, MiB; 0 when it cannot be read (it may have ended)."""
    try:
        pages = int((_PROC / str(pid) / "statm").read_text().split()[1])
        return pages * os.sysconf("SC_PAGE_SIZE") / MIB
    except (OSError, ValueError, IndexError):
        return 0.0


def descendants(pid: int | str = "self") -> list[int]:
    """Process ids of children, their children and so on; [] where the system does not say."""
    found: list[int] = []
    try:
        for task in (_PROC / str(pid) / "task").iterdir():
            for child in (task / "children").read_text().split():
                found += [int(child), *descendants(child)]
    except (OSError, ValueError):
        pass
    return found


class PeakMemory:
    """Context manager. `peak_mib` is the largest resident memory of this process and its children
    together between entry and exit, MiB. `tick` is called on the sampling thread now and then."""

    def __init__(
        self, interval_s: float = 0.1, tick: Callable[[float], None] | None = None
    ) -> None:
        self.peak_mib = 0.0
        self._interval_s = interval_s
        self._tick = tick
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="peak-memory", daemon=True)

    def __enter__(self) -> PeakMemory:
        self._exact = _forget_peak()
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._ended.set()
        self._thread.join()
        self._sample()
        if self._exact:
            self.peak_mib = max(self.peak_mib, _peak_since_forgotten())
        if self.peak_mib == 0.0:
            self.peak_mib = _process_peak_mib()

    def _watch(self) -> None:
        while not self._ended.wait(self._interval_s):
            self._sample()
            if self._tick is not None:
                self._tick(self.peak_mib)

    def _sample(self) -> None:
        now = resident_mib() + sum(resident_mib(child) for child in descendants())
        self.peak_mib = max(self.peak_mib, now)


def _forget_peak() -> bool:
    try:
        (_PROC / "self" / "clear_refs").write_text("5")
        return True
    except OSError:
        return False


def _peak_since_forgotten() -> float:
    try:
        for line in (_PROC / "self" / "status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) / 1024.0
    except (OSError, ValueError):
        pass
    return 0.0


def _process_peak_mib() -> float:
    if sys.platform == "win32":
        return 0.0
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / MIB if sys.platform == "darwin" else peak / 1024.0
