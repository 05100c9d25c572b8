"""How many photographs are placed, told as evenly as they take time."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from types import TracebackType

from stages.structure.ticks import Ticks

LONG_S = 1.0  # between two photographs: so long only if all cameras were adjusted between them
_EVERY_S = 0.3


class Placing:
    """Context manager; told of each photograph, it keeps `ticks` up to date.

    For each tenth more photographs, COLMAP adjusts all cameras and says nothing meanwhile; with
    hundreds that takes longer than to place them. What is told therefore follows what is placed at
    the pace so far, adjusting included, and catches up while cameras are adjusted.
    """

    def __init__(
        self, ticks: Ticks, total: int, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._ticks, self._total, self._clock = ticks, total, clock
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._tell, daemon=True)
        self._begin()

    def _begin(self) -> None:
        self._begun = self._last = self._settled_at = self._clock()
        self._count = self._settled = 0

    def __enter__(self) -> Placing:
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._ended.set()
        self._thread.join()

    def began(self) -> None:
        """A model begins, with its first two photographs."""
        self._begin()
        self._count = 2

    def placed(self) -> None:
        """One photograph more."""
        now = self._clock()
        self._count += 1
        if now - self._last >= LONG_S:
            self._settled, self._settled_at = self._count, now
        self._last = now

    def told(self) -> int:
        """Photographs to say that are placed."""
        if not self._settled:
            return min(self._count, self._total)
        pace = self._settled / max(self._settled_at - self._begun, 1e-9)
        expected = self._settled + pace * (self._clock() - self._settled_at)
        return min(int(expected), self._count, self._total)

    def _tell(self) -> None:
        while not self._ended.wait(_EVERY_S):
            self._ticks.write("placing photographs", self.told(), self._total)
