"""What the limits of Linux' control groups leave: memory, and processors.

A container's limits are those of such groups, and what the machine has says nothing of them: the
kernel ends a process that takes more memory than its group may. A process is in one group of each
hierarchy, and the limits of the groups above hold, too (the kernel's admin-guide/cgroup-v2 and
cgroup-v1). In a container the group's path may be the host's, which is not mounted there: then the
group at the mount's root is the container's.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path, PurePosixPath

PROCESS, MOUNTS = Path("/proc/self"), Path("/sys/fs/cgroup")


def free_bytes(process: Path = PROCESS, mounts: Path = MOUNTS) -> float:
    """Bytes that the process's groups may still take; infinity without a limit or such groups.

    Args:
        process: the folder of the process in procfs.
        mounts: where the hierarchies are mounted.
    """
    found = [math.inf]
    for group in _groups("memory", process, mounts):
        with suppress(OSError, ValueError):  # no such group, or "max": no limit
            found.append(_free_bytes(group))
    return max(0.0, min(found))


def processors(process: Path = PROCESS, mounts: Path = MOUNTS) -> float:
    """Processors that the process's groups may keep busy; infinity without a limit. Arguments as
    for `free_bytes`."""
    found = [math.inf]
    for group in _groups("cpu", process, mounts):
        with suppress(OSError, ValueError):
            quota, period = _quota_and_period(group)
            if quota > 0 and period > 0:
                found.append(quota / period)
    return min(found)


def _groups(controller: str, process: Path, mounts: Path) -> Iterator[Path]:
    """The process's groups of a controller's hierarchy and of version 2's, and those above them."""
    lines = []
    with suppress(OSError):
        lines = (process / "cgroup").read_text().splitlines()
    for line in lines:
        _, controllers, path = line.split(":", 2)
        if controllers and controller not in controllers.split(","):
            continue
        group = PurePosixPath(path).relative_to("/")
        for name in (controllers, controller) if controllers else ("", "unified"):
            yield from (mounts / name / inner for inner in (group, *group.parents))


def _free_bytes(group: Path) -> float:
    """The limit less what is used. The kernel drops cached files before it runs out of memory."""
    second = (group / "memory.max").exists()
    names = ("memory.max", "memory.current", "inactive_file")
    if not second:
        names = ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file")
    limit, usage, cached = names
    free = int((group / limit).read_text()) - int((group / usage).read_text())
    statistics = dict(line.split() for line in (group / "memory.stat").read_text().splitlines())
    return float(free + int(statistics.get(cached, 0)))


def _quota_and_period(group: Path) -> tuple[int, int]:
    """Time that the group may use of all processors in a period, and the period, microseconds."""
    if (group / "cpu.max").exists():
        quota, period = (group / "cpu.max").read_text().split()
        return int(quota), int(period)
    names = "cpu.cfs_quota_us", "cpu.cfs_period_us"  # -1: no limit
    quota, period = ((group / name).read_text() for name in names)
    return int(quota), int(period)
