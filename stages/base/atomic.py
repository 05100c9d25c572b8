"""Files appear under their final names whole, or not at all."""

from __future__ import annotations

import errno
import os
import platform
import re
import shutil
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from stages.base.disk import is_full
from stages.base.errors import Family, SplatError

_LEFT = ".partial-"


def partial_prefix() -> str:
    """What the names of files and folders begin with that are not whole yet. It says which process
    of which machine makes them, for `clear_left`."""
    return f"{_LEFT}{_machine()}-{os.getpid()}-"


def _machine() -> str:
    return f"{zlib.crc32(platform.node().encode()):08x}"


def remove_abandoned_files(folder: Path) -> None:
    """Delete what processes of this machine that were killed left half-written in `folder`."""
    if os.name != "posix":  # elsewhere to ask whether a process runs would end it
        return
    mark = re.compile(re.escape(f"{_LEFT}{_machine()}-") + r"(\d+)-")
    with suppress(OSError):  # nobody waits for it
        for left in list(folder.iterdir()):
            found = mark.match(left.name)
            if found and not _runs(int(found[1])):
                left.unlink() if not left.is_dir() else shutil.rmtree(left, ignore_errors=True)


def _runs(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):  # somebody else's
        return True
    return True


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a name beside `path` to write to; it takes the place of `path` when the block ends.

    The name keeps the suffix, because some writers choose the format by it. If the block raises,
    the temporary file is deleted and `path` is as it was. Raises SplatError "disk-full" or
    "file-not-written" for what the operating system refuses.
    """
    path = Path(path)
    temporary = path.with_name(partial_prefix() + path.name)
    try:
        if not path.parent.is_dir():  # said here, because some writers would make the folder
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(path.parent))
        yield temporary
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError as error:
        raise _refused(path, error) from error
    finally:
        # The error that matters is already on its way if even this is refused.
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def make_folder(folder: Path) -> None:
    """Make `folder`, and those that it lies in. Raises SplatError "folder-not-made"."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SplatError(
            "folder-not-made",
            given=f"{folder} cannot be made: {error.strerror or error}.",
            wanted="A place where a folder may be made.",
            hint="Name another one.",
            family=Family.RESOURCES,
        ) from error


def _refused(path: Path, error: OSError) -> SplatError:
    reason = error.strerror or str(error)
    if error.errno in (errno.ENOSPC, errno.EDQUOT) or (
        # NumPy and the USD library do not say why a write failed: look.
        error.errno is None and is_full(path.parent)
    ):
        return SplatError(
            "disk-full",
            given=f"{path} could not be written: {reason}.",
            wanted="The disk must have room for it.",
            hint="Free some space, or choose a folder on another disk, and run the command again.",
            family=Family.RESOURCES,
        )
    return SplatError(
        "file-not-written",
        given=f"{path} could not be written: {reason}.",
        wanted="Its folder must exist and be writable.",
        hint="Check the folder's permissions, or choose another one.",
        family=Family.RESOURCES,
    )
