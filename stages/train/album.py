"""Many pictures in little memory: they are in a file that is memory-mapped, not loaded."""

from __future__ import annotations

import mmap
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

RESIDENT_MIB = 1024  # roughly at most, of pictures that count as this process's memory


class Album:
    """Pictures in a memory-mapped temporary file, each an array of bytes.

    The file has no name where the system allows it, so nothing of it is left however the process
    ends. The system keeps in memory what fits, and drops the rest first when memory is short.
    Beyond `resident_mib` the process releases the pages that it has touched.

    Pictures are added inside the context manager (`add`), and can be read after it (`picture`)
    until the object is garbage collected.
    """

    def __init__(self, folder: Path, resident_mib: float = RESIDENT_MIB) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._file = tempfile.TemporaryFile(dir=folder, prefix="pictures-")  # noqa: SIM115 - closed on exit
        self._shapes: list[tuple[int, ...]] = []
        self._starts = [0]
        self._most = int(resident_mib * 2**20)
        self._touched: set[int] = set()
        self._bytes = 0
        self._map: mmap.mmap | None = None

    def __enter__(self) -> Album:
        return self

    def __exit__(self, kind: object, *exception: object) -> None:
        self._file.flush()
        if kind is None and self._starts[-1]:
            self._map = mmap.mmap(self._file.fileno(), self._starts[-1])
        self._file.close()

    def add(self, picture: NDArray[np.uint8]) -> int:
        """Add a copy and return its number. Raises OSError if the disk is full."""
        self._file.write(np.ascontiguousarray(picture).data)
        self._shapes.append(picture.shape)
        self._starts.append(self._starts[-1] + picture.nbytes)
        return len(self._shapes) - 1

    def picture(self, number: int) -> NDArray[np.uint8]:
        """A view of the mapped bytes, to be read and not kept for long."""
        assert self._map is not None
        start, end = self._starts[number : number + 2]
        if number not in self._touched:
            if self._bytes + end - start > self._most:
                self._release()
            self._touched.add(number)
            self._bytes += end - start
        flat = np.frombuffer(self._map, np.uint8, end - start, start)
        return flat.reshape(self._shapes[number])

    def expect(self, number: int) -> None:
        """Announce that a picture is needed soon, so that the system can begin to read it."""
        assert self._map is not None
        start = self._starts[number] // mmap.PAGESIZE * mmap.PAGESIZE
        self._advise("MADV_WILLNEED", start, self._starts[number + 1] - start)

    def _release(self) -> None:
        """Release touched pages: they stay in the system's cache, but do not count as ours."""
        assert self._map is not None
        self._touched.clear()
        self._bytes = 0
        self._advise("MADV_DONTNEED", 0, self._starts[-1])

    def _advise(self, advice: str, start: int, length: int) -> None:
        assert self._map is not None
        value = getattr(mmap, advice, None)  # not on Windows, which manages it itself
        if value is not None:
            self._map.madvise(value, start, length)
