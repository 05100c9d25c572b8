"""Files that appear under their final names complete, or not at all."""

from __future__ import annotations

import csv
import errno
import gc
import os
import platform
import re
import shutil
import tempfile
import time
import zlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import psutil

from stages.base.disk import DISK_FULL, disk_full, is_full
from stages.base.errors import ResourceError, SplatError

_PARTIAL = ".partial-"
_NAME_BYTES = 255
_WINDOWS = os.name == "nt"
_WAITS_S = (0.05, 0.1, 0.2, 0.4, 0.8, 1.6)


def partial_prefix() -> str:
    """Start of the name of every file and folder that is not complete yet. It holds the machine and
    the process that write it, for `remove_abandoned_files`."""
    return f"{_PARTIAL}{_machine()}-{os.getpid()}-"


def _machine() -> str:
    return f"{zlib.crc32(platform.node().encode()):08x}"


def remove_abandoned_files(folder: Path) -> None:
    """Delete incomplete files in `folder` whose process, on this machine, has ended."""
    partial = re.compile(re.escape(f"{_PARTIAL}{_machine()}-") + r"(\d+)-")
    with suppress(OSError, OverflowError):  # tidying up must not stop the work
        for path in list(folder.iterdir()):
            process = partial.match(path.name)
            if process and not psutil.pid_exists(int(process[1])):
                path.unlink() if not path.is_dir() else shutil.rmtree(path, ignore_errors=True)


def rename(source: Path, target: Path) -> None:
    """Rename a file or a folder, and replace a file of that name. Raises OSError.

    Windows refuses while a file is open or mapped, here or by a scanner of viruses: maps that
    nothing refers to are closed, and it is tried again for three seconds.
    """
    for wait_s in (*_WAITS_S, None):
        try:
            os.replace(source, target)
            return
        except PermissionError:
            if not _WINDOWS or wait_s is None:
                raise
            gc.collect()
            time.sleep(wait_s)


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary name beside `path`; its file replaces `path` when the block ends.

    The name keeps the suffix, because some writers choose the format by it. If the block raises,
    the temporary file is deleted and `path` is unchanged. Raises SplatError "disk-full" or
    "file-not-written" if the operating system refuses the write.
    """
    path = Path(path)
    temporary = path.with_name(_temporary_name(path.name))
    try:
        if not path.parent.is_dir():  # checked here, because some writers would make the folder
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(path.parent))
        yield temporary
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())
        rename(temporary, path)
        sync_folder(path.parent)
    except OSError as error:
        raise _refused(path, error) from error
    finally:
        # An error here must not hide the one that is being raised.
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


@contextmanager
def temporary_beside(path: Path) -> Iterator[Path]:
    """Yield a path that ends as `path` does, folder and name, in a temporary folder beside it,
    which is removed when the block ends. Raises as `replacing`."""
    try:
        with tempfile.TemporaryDirectory(dir=path.parent, prefix=partial_prefix()) as name:
            folder = Path(name) / path.absolute().parent.name
            folder.mkdir(exist_ok=True)
            yield folder / path.name
    except OSError as error:
        raise _refused(path, error) from error


def _temporary_name(name: str) -> str:
    """`partial_prefix` and the name; of a very long name the checksum and the end, because file
    systems allow `_NAME_BYTES` at most."""
    prefix = partial_prefix()
    if len(os.fsencode(prefix + name)) <= _NAME_BYTES:
        return prefix + name
    checksum = f"{zlib.crc32(os.fsencode(name)):08x}-"
    while len(os.fsencode(prefix + checksum + name)) > _NAME_BYTES:
        name = name[1:]
    return prefix + checksum + name


def write_csv(path: Path, rows: Iterable[Iterable[object]]) -> None:
    """Write a table, its head first, as `replacing` does. Raises SplatError."""
    with replacing(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows(rows)


def sync_folder(folder: Path) -> None:
    """Flush the entries of `folder` to the disk, so that a rename in it survives a power cut.

    Does nothing on systems and file systems that cannot flush a folder.
    """
    with suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def make_folder(folder: Path) -> None:
    """Make `folder` and its parents. Raises SplatError "folder-not-made"."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ResourceError(
            "folder-not-made",
            given=f"{folder} cannot be made: {error.strerror or error}.",
            wanted="A place where a folder may be made.",
            hint="Name another one.",
        ) from error


def _refused(path: Path, error: OSError) -> SplatError:
    reason = error.strerror or str(error)
    folder = _lasting(path.parent)
    # NumPy and the USD library do not say why a write failed.
    if error.errno in DISK_FULL or (error.errno is None and is_full(folder)):
        return disk_full(f"writing {path.name}", folder)
    wanted = "Its folder must exist and be writable."
    hint = "Check the folder's permissions, or choose another one."
    if error.errno == errno.EFBIG:
        wanted = "A place that holds files of this size: FAT32 ends at 4 GiB, `ulimit -f` earlier."
        hint = "Choose another place, or raise the limit."
    return ResourceError(
        "file-not-written",
        given=f"{folder / path.name} could not be written: {reason}.",
        wanted=wanted,
        hint=hint,
    )


def _lasting(folder: Path) -> Path:
    """The folder that stays of a temporary one of `temporary_beside`, which nobody would find."""
    for parent in (folder, *folder.parents):
        if parent.name.startswith(_PARTIAL):
            return _lasting(parent.parent)
    return folder
