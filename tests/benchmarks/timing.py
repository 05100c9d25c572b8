"""Timing on shared machines: interleaved rounds, medians, and seconds of each kernel."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import time
import tracemalloc
from collections import defaultdict
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from stages.raster.kernels.pool import Pool

Job = Callable[[], Any]


class TimedPool(Pool):
    """A pool that adds up the seconds that each kernel took."""

    def __init__(self, n_threads: int | None = None) -> None:
        super().__init__(n_threads)
        self.seconds: dict[str, float] = defaultdict(float)

    def share(
        self, kernel: Callable[..., Any], *args: Any, beside: Callable[[], Any] | None = None
    ) -> None:
        start = time.perf_counter()
        super().share(kernel, *args, beside=beside)
        self.seconds[kernel.__name__] += time.perf_counter() - start


def interleaved(jobs: dict[str, Job], rounds: int) -> dict[str, float]:
    """Median seconds of each job; all run once in each round, and the first round is dropped."""
    taken: dict[str, list[float]] = {name: [] for name in jobs}
    for number in range(rounds + 1):
        for name, job in jobs.items():
            start = time.perf_counter()
            job()
            if number:
                taken[name].append(time.perf_counter() - start)
    return {name: float(np.median(values)) for name, values in taken.items()}


def kernel_seconds(pool: TimedPool, job: Job, rounds: int) -> dict[str, float]:
    """Median seconds of each kernel in `job`, and of the whole under "total"."""
    job()
    taken: dict[str, list[float]] = defaultdict(list)
    for _ in range(rounds):
        pool.seconds.clear()
        start = time.perf_counter()
        job()
        taken["total"].append(time.perf_counter() - start)
        for name, value in pool.seconds.items():
            taken[name].append(value)
    return {name: float(np.median(values)) for name, values in taken.items()}


def rounds_for(job: Job, seconds: float = 2.0) -> int:
    """How many rounds of `job` fit in so many seconds; 3 to 30."""
    job()
    start = time.perf_counter()
    job()
    return int(np.clip(seconds / (time.perf_counter() - start), 3, 30))


def peak_bytes(job: Job) -> int:
    """Most bytes that Python and NumPy held at once during `job` beyond those held before."""
    tracemalloc.start()
    try:
        before = tracemalloc.get_traced_memory()[0]
        tracemalloc.reset_peak()
        job()
        return tracemalloc.get_traced_memory()[1] - before
    finally:
        tracemalloc.stop()


@contextlib.contextmanager
def busy_core() -> Iterator[None]:
    """Another process that keeps one core busy."""
    process = subprocess.Popen([sys.executable, "-c", "while True: pass"])
    try:
        time.sleep(0.3)
        yield
    finally:
        process.kill()
        process.wait()


def growth(sizes: list[float], seconds: list[float]) -> float:
    """Exponent of the power law through the points (least squares of logarithms)."""
    return float(np.polyfit(np.log(sizes), np.log(seconds), 1)[0])


def machine() -> str:
    """One line on what this ran on, and how busy it was."""
    name = "unknown processor"
    with contextlib.suppress(OSError), open("/proc/cpuinfo") as lines:
        name = next((x.split(":")[1].strip() for x in lines if x.startswith("model name")), name)
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else float("nan")
    return f"{name}, {len(os.sched_getaffinity(0))} cores, load {load:.1f}"
