"""Work on many rows a block at a time, so that temporary arrays stay small.

Progress goes to a callback: `with progress_reported_to(callback): formats.read(path)`. Readers and
writers pass over the rows more than once (values, order, one attribute after another); the
callback gets the progress of the current pass.
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
ProgressCallback = Callable[[int, int], None]  # (done, total) of a pass, mostly rows
_callback: ContextVar[ProgressCallback | None] = ContextVar("progress", default=None)


@contextmanager
def progress_reported_to(callback: ProgressCallback) -> Iterator[None]:
    """Call `callback` during every pass inside the block, on the working thread."""
    token = _callback.set(callback)
    try:
        yield
    finally:
        _callback.reset(token)


def blocks(count: int, rows: int = ROWS) -> Iterator[slice]:
    """Slices of at most `rows` that cover 0..count. Pages of scratch arrays are released after
    each."""
    for start in range(0, count, rows):
        yield slice(start, min(start + rows, count))
        release_scratch_pages()


def reported_blocks(count: int, rows: int = ROWS) -> Iterator[slice]:
    """`blocks` with progress reports, for a slow pass."""
    for part in blocks(count, rows):
        yield part
        report_progress(part.stop, count)


def report_progress(done: int, total: int) -> None:
    """Report the progress of a pass that does not go by rows."""
    callback = _callback.get()
    if callback is not None:
        callback(done, total)


def release_mapped_pages(mapped: NDArray[np.generic]) -> None:
    """Release the pages of a mapped file that were read; the next access reads them again.

    Otherwise a file that was read once counts as memory in use. Does nothing on systems without
    madvise, or for an array that is not mapped.
    """
    holder = getattr(mapped, "_mmap", None)
    with suppress(AttributeError, ValueError, OSError):
        holder.madvise(mmap.MADV_DONTNEED)  # type: ignore[union-attr]
