"""A pool of threads for kernels that release the GIL.

Unlike OpenMP's, these threads do not spin while they wait, do not compete with torch's pool, and
need no library. Work is shared through a counter (`take_ticket`), so that a thread that lost
its core to another process does not delay the others.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from stages.base import threads


class Pool:
    """Runs one kernel call for each thread; the calling thread takes part."""

    def __init__(self, n_threads: int | None = None) -> None:
        self.n_threads = n_threads or threads.count()
        self._others = (
            ThreadPoolExecutor(self.n_threads - 1, thread_name_prefix="splat")
            if self.n_threads > 1
            else None
        )

    def share(
        self,
        kernel: Callable[..., Any],
        *args: Any,
        beside: Callable[[], Any] | None = None,
    ) -> None:
        """Call kernel(counter, *args) in every thread; see `take_ticket` for the counter. Several
        threads may call this at the same time.

        beside: a function that the calling thread runs first, while the others begin.
        """
        counter = np.zeros(1, np.int64)  # of this call: another thread may draw, too
        futures = [
            self._others.submit(kernel, counter, *args)
            for _ in range(self.n_threads - 1)
            if self._others is not None
        ]
        if beside is not None:
            beside()
        kernel(counter, *args)
        for future in futures:
            future.result()


_default: list[Pool] = []


def default_pool() -> Pool:
    """The pool of this process, made at first use."""
    if not _default:
        _default.append(Pool())
    return _default[0]
