"""How many photographs are placed, told as evenly as they take time."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from types import TracebackType

from stages.structure.worker_progress import ProgressWriter

LONG_S = 0.5  # between two photographs: so long mostly if all cameras were adjusted between them
ENDING = 0.4  # of all the time: what follows when all are placed, adjusting all of them once more
_EVEN = 0.8  # of that is told when it has taken as long as expected; what is left, ever slower
_CAUTION = 0.9  # of the pace so far: who is ahead of what is placed must stand and wait
_EVERY_S = 0.3


class Placing:
    """Context manager; told of each photograph, it keeps `ticks` up to date.

    For each fifth more photographs, COLMAP adjusts all cameras and says nothing meanwhile; with
    hundreds that takes longer than to place them. What is told therefore follows what is placed at
    the pace so far, adjusting included, and catches up while cameras are adjusted. Room is left for
    the last adjustments, whose end nobody knows: of what is left to tell, they tell ever less.
    """

    def __init__(
        self, ticks: ProgressWriter, total: int, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._ticks, self._total, self._clock = ticks, total, clock
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._tell, daemon=True)
        self._begin()

    def _begin(self) -> None:
        self._begun = self._last = self._settled_at = self._clock()
        self._count = self._settled = self._told = 0
        self._ending_since: float | None = None

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
        if self._count >= self._total:
            self.ending()

    def ending(self) -> None:
        """Nothing more will be placed."""
        if self._ending_since is None:
            self._told, self._ending_since = self.told(), self._clock()

    def told(self) -> int:
        """Photographs to say that are placed."""
        now = self._clock()
        if self._ending_since is not None:
            expected = max(self._ending_since - self._begun, 1e-9) * ENDING / (1 - ENDING)
            share = _EVEN * (now - self._ending_since) / expected
            if share > _EVEN:
                share = 1 - (1 - _EVEN) * math.exp((_EVEN - share) / (1 - _EVEN))
            return self._told + int((self._total - self._told) * share)
        placed = float(self._count)
        if self._settled:
            pace = _CAUTION * self._settled / max(self._settled_at - self._begun, 1e-9)
            placed = min(placed, self._settled + pace * (now - self._settled_at))
        return int((1 - ENDING) * min(placed, self._total))

    def _tell(self) -> None:
        while not self._ended.wait(_EVERY_S):
            self._ticks.write("placing photographs", self.told(), self._total)
