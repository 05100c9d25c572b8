"""Number of threads, and settings of OpenMP and OpenBLAS, made before NumPy, torch, Numba or OpenCV
load.

By default their threads spin while they wait. If another process uses the same cores, training
then takes ten times as long. The matrices here are small: OpenBLAS takes 60 times as long to solve
100 equations with two threads as with one.
"""

from __future__ import annotations

import math
import os

from stages.base import cgroups


def configure() -> None:
    """Set OpenMP's waiting policy and one thread for OpenBLAS, unless the user has set them."""
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def count() -> int:
    """Number of threads: SPLAT_THREADS if set, else the cores that this process may run on, within
    a container's limit."""
    wanted = os.environ.get("SPLAT_THREADS", "")
    if wanted.isdigit() and int(wanted) > 0:
        return int(wanted)
    try:
        cores = len(os.sched_getaffinity(0))
    except AttributeError:  # macOS, Windows
        return os.cpu_count() or 1
    limit = cgroups.processors()
    return cores if limit >= cores else max(1, math.ceil(limit))
