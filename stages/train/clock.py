"""Time that training took, summed over interruptions."""

from __future__ import annotations

import time
from dataclasses import dataclass


@dataclass(frozen=True)
class Elapsed:
    """Wall seconds, and CPU seconds of all threads of this process."""

    seconds: float = 0.0
    cpu_seconds: float = 0.0


class Clock:
    """Measures time from its creation on, added to what earlier processes took."""

    def __init__(self, before: Elapsed | None = None) -> None:
        self._before = before or Elapsed()
        self._wall, self._cpu = time.monotonic(), time.process_time()

    def elapsed(self) -> Elapsed:
        return Elapsed(
            self._before.seconds + time.monotonic() - self._wall,
            self._before.cpu_seconds + time.process_time() - self._cpu,
        )
