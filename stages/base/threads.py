"""Thread pools, set up before torch, Numba or OpenCV load.

OpenMP's default is to spin while it waits. With another process on the same cores a training run
then takes ten times as long, and laptops are busy machines.
"""

from __future__ import annotations

import os


def configure() -> None:
    """Set OpenMP's waiting policy, unless the user did."""
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")


def count() -> int:
    """Threads to use: SPLAT_THREADS if set, else the cores that this process may run on."""
    wanted = os.environ.get("SPLAT_THREADS", "")
    if wanted.isdigit() and int(wanted) > 0:
        return int(wanted)
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # macOS, Windows
        return os.cpu_count() or 1
