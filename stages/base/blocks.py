"""Work on many rows a block at a time, so that what is made on the way stays small.

Who wants to know how far the work is watches it: `with watched(watcher): formats.read(path)`.
Readers and writers go over the rows more than once (values, order, one attribute after the other),
so what is told is the pass that is going on.
"""

from __future__ import annotations

import mmap
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar

import numpy as np
from numpy.typing import NDArray

from stages.base.scratch import release_scratch_pages

ROWS = 1 << 16  # 16 MB of splats of degree 3
Watcher = Callable[[int, int], None]  # (done, in all) of a pass: rows, mostly
_watcher: ContextVar[Watcher | None] = ContextVar("watcher", default=None)


@contextmanager
def progress_reported_to(watcher: Watcher) -> Iterator[None]:
    """`watcher` hears of every pass inside the block, on the thread that works."""
    token = _watcher.set(watcher)
    try:
        yield
    finally:
        _watcher.reset(token)


def blocks(count: int, rows: int = ROWS) -> Iterator[slice]:
    """0..count in slices of `rows`. Scratch arrays stay on their disk between one and the next."""
    for start in range(0, count, rows):
        yield slice(start, min(start + rows, count))
        release_scratch_pages()


def reported_blocks(count: int, rows: int = ROWS) -> Iterator[slice]:
    """`blocks`, told to who watches: for a pass that takes its time."""
    for part in blocks(count, rows):
        yield part
        report_progress(part.stop, count)


def report_progress(done: int, total: int) -> None:
    """To who watches, of a pass that does not go by rows."""
    watcher = _watcher.get()
    if watcher is not None:
        watcher(done, total)


def release_mapped_pages(mapped: NDArray[np.generic]) -> None:
    """Let go of the pages of a mapped file that were read; the next look reads them again.

    Without it a file that is gone through once counts as memory in use. Does nothing where the
    system does not offer it, or for an array that is not mapped.
    """
    holder = getattr(mapped, "_mmap", None)
    with suppress(AttributeError, ValueError, OSError):
        holder.madvise(mmap.MADV_DONTNEED)  # type: ignore[union-attr]
