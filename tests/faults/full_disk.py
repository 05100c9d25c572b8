"""Disks that become full: each stage on a file system of a few kilobytes, and upwards."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Callable, Iterator
from pathlib import Path

from tests.faults.small_run import SmallRun, forked, stage_command

_NEW_USER, _NEW_MOUNTS, _PRIVATE, _REMOUNT = 0x10000000, 0x20000, 0x44000, 0x20
_PAGE = 4096
_NO_MOUNT = 77  # exit status where file systems may not be mounted


def sizes(most: int) -> Iterator[int]:
    """4 kB, and doubled up to `most` bytes."""
    size = _PAGE
    while size < most:
        yield size
        size *= 2


def filled(run: SmallRun, stage: str, room: int, folder: Path) -> str:
    """Run `stage` where only `room` bytes are free, give it more, and run it again.

    Returns "full" (reported, then the same bytes), "enough" (it had enough room), "no mount",
    or what is wrong.
    """
    disk, log = folder / "disk", folder / "full.log"
    disk.mkdir(parents=True, exist_ok=True)
    status, shown = forked(lambda: _tried(run, stage, room, disk, log), folder / "log")
    return "no mount" if status == _NO_MOUNT else shown.strip()


def _tried(run: SmallRun, stage: str, room: int, disk: Path, log: Path) -> None:
    mount, folder = _mounting(), disk / "work"
    if mount is None or mount(disk, "64m", 0):
        os._exit(_NO_MOUNT)
    run.before(stage, folder)
    space = os.statvfs(disk)
    used = (space.f_blocks - space.f_bfree) * space.f_frsize
    mount(disk, str(used + room), _REMOUNT)
    status, shown = forked(lambda: stage_command(stage, folder), log)
    if status == 0:
        print("enough")
        return
    if status != 6 or "disk-full" not in shown or "Traceback" in shown:
        print(f"status {status}: {shown[-600:]}")
        return
    mount(disk, "64m", _REMOUNT)
    status, shown = forked(lambda: stage_command(stage, folder), log)
    if status:
        print(f"not resumed, status {status}: {shown[-600:]}")
        return
    print(run.fault_of(stage, folder) or "full")


def _mounting() -> Callable[[Path, str, int], int] | None:
    """A function (folder, size, flags) that mounts a file system in memory for this process alone
    and returns 0; None where that is not permitted."""
    try:
        libc = ctypes.CDLL(None, use_errno=True)
        own, user, group = libc.unshare, os.getuid(), os.getgid()
    except (AttributeError, OSError):
        return None
    if own(_NEW_MOUNTS):
        if own(_NEW_USER | _NEW_MOUNTS):
            return None
        Path("/proc/self/setgroups").write_text("deny")
        Path("/proc/self/uid_map").write_text(f"0 {user} 1")
        Path("/proc/self/gid_map").write_text(f"0 {group} 1")
    if libc.mount(b"none", b"/", None, _PRIVATE, None):
        return None
    return lambda folder, size, flags: libc.mount(
        b"tmpfs", os.fsencode(folder), b"tmpfs", flags, f"size={size}".encode()
    )
