"""CPU seconds and memory of one input, and the limits that make it a failure.

CPU seconds are those of the process and of the processes that it started; unlike seconds on the
clock they do not depend on what else the machine does. Memory is what was resident at most, beyond
what was resident before the first input: Linux resets the peak on request (proc(5), clear_refs),
and `ENVIRONMENT` makes the C library give back what is freed.
"""

from __future__ import annotations

import os
import resource
import signal
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

CPU_LIMIT_S = 5.0  # inputs of some 10 kB take thousandths of a second
PEAK_LIMIT_MIB = 256.0
ENVIRONMENT = {"MALLOC_MMAP_THRESHOLD_": "65536", "MALLOC_TRIM_THRESHOLD_": "65536"}
_ADDRESS_SPACE_BYTES = 2 << 30  # beyond what the process has before the first input
_SELF, _CHILDREN = resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN
_STATUS = Path("/proc/self/status")


@dataclass(frozen=True)
class Cost:
    """Of one input."""

    cpu_s: float
    peak_mib: float


class Meter:
    """From now on: CPU seconds, and resident memory beyond `resident_kib`."""

    def __init__(self, resident_kib: int | None = None) -> None:
        Path("/proc/self/clear_refs").write_text("5")
        self._resident = resident_now_kib() if resident_kib is None else resident_kib
        self._cpu = _cpu_s()

    def stop(self) -> Cost:
        return Cost(_cpu_s() - self._cpu, max(0, _kib("VmHWM") - self._resident) / 1024)


def resident_now_kib() -> int:
    return _kib("VmRSS")


def limit_process() -> None:
    """From here on, a huge count that is believed fails with MemoryError."""
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    limit = pages * resource.getpagesize() + _ADDRESS_SPACE_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (limit, resource.getrlimit(resource.RLIMIT_AS)[1]))


def limit_cpu() -> None:
    """The process dies of SIGXCPU when an input takes much longer than `CPU_LIMIT_S`."""
    used = resource.getrusage(_SELF)
    soft = int(used.ru_utime + used.ru_stime + 2 * CPU_LIMIT_S) + 1
    resource.setrlimit(resource.RLIMIT_CPU, (soft, resource.getrlimit(resource.RLIMIT_CPU)[1]))


def in_fork(read: Callable[[], int]) -> tuple[int, Cost]:
    """(status, cost) of `read` in a copy of this process; a status below 0 is a signal."""
    resident = _kib("VmRSS")
    child = os.fork()
    if child == 0:
        status = 1
        try:
            limit_cpu()
            silent = os.open(os.devnull, os.O_WRONLY)
            os.dup2(silent, 1)
            os.dup2(silent, 2)
            status = read()
        finally:
            os._exit(status)
    _, status, used = os.wait4(child, 0)
    cost = Cost(used.ru_utime + used.ru_stime, max(0, used.ru_maxrss - resident) / 1024)
    return os.waitstatus_to_exitcode(status), cost


OUT_OF_CPU = -signal.SIGXCPU


def _cpu_s() -> float:
    every = [resource.getrusage(who) for who in (_SELF, _CHILDREN)]
    return sum(used.ru_utime + used.ru_stime for used in every)


def _kib(field: str) -> int:
    text = _STATUS.read_text()
    at = text.index(field)
    return int(text[at : at + 40].split()[1])
