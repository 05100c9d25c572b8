"""Work on many rows a slice at a time, so that temporary arrays stay small."""

from __future__ import annotations

import mmap
from collections.abc import Iterator
from contextlib import suppress

import numpy as np
from numpy.typing import NDArray

from stages.base.scratch import release_scratch_pages

ROWS = 1 << 16  # 16 MB of splats of degree 3


def row_slices(count: int, rows: int = ROWS) -> Iterator[slice]:
    """Slices of at most `rows` that cover 0..count. Pages of scratch arrays are released after
    each."""
    for start in range(0, count, rows):
        yield slice(start, min(start + rows, count))
        release_scratch_pages()


def release_mapped_pages(mapped: NDArray[np.generic]) -> None:
    """Release the pages of a mapped file that were read; the next access reads them again.

    Otherwise a file that was read once counts as memory in use. Does nothing on systems without
    madvise, or for an array that is not mapped.
    """
    holder = getattr(mapped, "_mmap", None)
    with suppress(AttributeError, ValueError, OSError):
        holder.madvise(mmap.MADV_DONTNEED)  # type: ignore[union-attr]
