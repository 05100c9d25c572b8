"""Number of threads, and OpenMP's settings, made before torch, Numba or OpenCV load.

By default OpenMP's threads spin while they wait. If another process uses the same cores, training
then takes ten times as long.
"""

from __future__ import annotations

import os


def configure() -> None:
    """Set OpenMP's waiting policy, unless the user has set it."""
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")


def count() -> int:
    """Number of threads: SPLAT_THREADS if set, else the cores that this process may run on."""
    wanted = os.environ.get("SPLAT_THREADS", "")
    if wanted.isdigit() and int(wanted) > 0:
        return int(wanted)
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # macOS, Windows
        return os.cpu_count() or 1
