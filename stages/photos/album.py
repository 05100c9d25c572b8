"""Many pictures in little memory: their bytes lie in a file that is mapped, not loaded."""

from __future__ import annotations

import mmap
import tempfile
from pathlib import Path
from types import TracebackType

import numpy as np
from numpy.typing import NDArray

RESIDENT_MIB = 1024  # of an album, at most and about, that count as this process's memory


class Album:
    """Pictures that were added once, read as often as wanted, each an array of bytes.

    The file is nameless where the system allows it, so that nothing is left of it however the
    process ends. The system keeps in memory what fits and drops the rest first when memory is
    short; beyond `resident_mib` the process gives back by itself what it has touched.

    Used as a context manager to `add`; after that, `pictures` may be read until it is closed by
    the garbage collector.
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

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._file.flush()
        if error is None and self._starts[-1]:
            self._map = mmap.mmap(self._file.fileno(), self._starts[-1])
        self._file.close()

    def add(self, picture: NDArray[np.uint8]) -> int:
        """Keep a copy; its number. Raises OSError where the disk is full."""
        self._file.write(np.ascontiguousarray(picture).data)
        self._shapes.append(picture.shape)
        self._starts.append(self._starts[-1] + picture.nbytes)
        return len(self._shapes) - 1

    def picture(self, number: int) -> NDArray[np.uint8]:
        """The bytes where they lie: to be read, and not kept for long."""
        assert self._map is not None
        start, end = self._starts[number : number + 2]
        if number not in self._touched:
            if self._bytes + end - start > self._most:
                self._let_go()
            self._touched.add(number)
            self._bytes += end - start
        flat = np.frombuffer(self._map, np.uint8, end - start, start)
        return flat.reshape(self._shapes[number])

    def expect(self, number: int) -> None:
        """That picture comes soon: the system may begin to read it, beside other work."""
        assert self._map is not None
        start = self._starts[number] // mmap.PAGESIZE * mmap.PAGESIZE
        self._advise("MADV_WILLNEED", start, self._starts[number + 1] - start)

    def _let_go(self) -> None:
        """What was touched stays in the system's cache, but is no longer this process's."""
        assert self._map is not None
        self._touched.clear()
        self._bytes = 0
        self._advise("MADV_DONTNEED", 0, self._starts[-1])

    def _advise(self, advice: str, start: int, length: int) -> None:
        assert self._map is not None
        value = getattr(mmap, advice, None)  # not under Windows, which looks after itself
        if value is not None:
            self._map.madvise(value, start, length)
