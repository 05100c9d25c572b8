"""Temporary arrays in files, for data larger than memory."""

from __future__ import annotations

import mmap
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from pathlib import Path
from typing import Any
from weakref import WeakSet

import numpy as np
from numpy.typing import NDArray

from stages.base.errors import ResourceError

LARGE_BYTES = 1 << 26
_folder: ContextVar[tuple[Path, bool] | None] = ContextVar("scratch", default=None)
_maps: WeakSet[mmap.mmap] = WeakSet()


@contextmanager
def scratch_in(folder: Path, spare: bool = False) -> Iterator[None]:
    """Inside the block, large arrays of `empty` are mapped from unnamed files in `folder`.

    The files vanish with the last reference to their array or with the process.

    spare: use memory instead whenever the disk would have less free space left than the array
        takes, and never raise an error.
    """
    token = _folder.set((folder, spare))
    try:
        yield
    finally:
        _folder.reset(token)


def empty(shape: tuple[int, ...], dtype: Any = np.float32) -> NDArray[Any]:
    """As np.empty; mapped from a file if it is large and inside a `scratch_in` block. Raises
    SplatError "disk-full"."""
    place, size = _folder.get(), int(np.prod(shape)) * np.dtype(dtype).itemsize
    if place is None or size < LARGE_BYTES:
        return np.empty(shape, dtype)
    folder, spare = place
    try:
        if spare and shutil.disk_usage(folder).free < 2 * size:
            return np.empty(shape, dtype)
        with tempfile.TemporaryFile(dir=folder, prefix=".scratch-") as file:
            # Reserved now: a full disk would end the process when a page is written.
            if hasattr(os, "posix_fallocate"):
                os.posix_fallocate(file.fileno(), 0, size)
            else:
                file.truncate(size)
            array = np.memmap(file, dtype, "r+", shape=shape)
    except OSError as error:
        if spare:
            return np.empty(shape, dtype)
        raise ResourceError(
            "disk-full",
            given=f"{folder} has no {size / 1e9:.1f} GB for temporary data: {error.strerror}.",
            wanted="The disk must have room for temporary data and for the output.",
            hint="Free some space, or write to a folder on another disk.",
        ) from error
    _maps.add(array._mmap)  # type: ignore[attr-defined]
    return array


def release_scratch_pages() -> None:
    """Release the memory of scratch arrays. Their contents stay in the files, from where the next
    access reads them."""
    for mapped in list(_maps):
        with suppress(AttributeError, ValueError, OSError):
            mapped.madvise(mmap.MADV_DONTNEED)
