"""Two or more threads for kernels that release the GIL.

Plain threads instead of an OpenMP team: nothing spins while it waits, torch's pool is not fought
for the cores, and nothing has to be installed. Work is shared through a counter (`take_ticket`),
so that a thread that lost its core to another process does not hold the rest up.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from stages.base import threads


class Pool:
    """Runs one kernel call per thread; the calling thread takes part."""

    def __init__(self, n_threads: int | None = None) -> None:
        self.n_threads = n_threads or threads.count()
        self._others = (
            ThreadPoolExecutor(self.n_threads - 1, thread_name_prefix="splat")
            if self.n_threads > 1
            else None
        )
        self._ticket = np.zeros(1, np.int64)

    def share(
        self,
        kernel: Callable[..., Any],
        *args: Any,
        beside: Callable[[], Any] | None = None,
    ) -> None:
        """kernel(counter, *args) in every thread; the kernel takes tickets from `counter`.

        beside: something else that one thread does first, while the others begin.
        """
        self._ticket[0] = 0
        futures = [
            self._others.submit(kernel, self._ticket, *args)
            for _ in range(self.n_threads - 1)
            if self._others is not None
        ]
        if beside is not None:
            beside()
        kernel(self._ticket, *args)
        for future in futures:
            future.result()


_default: list[Pool] = []


def default_pool() -> Pool:
    """The process's own pool, made at first use."""
    if not _default:
        _default.append(Pool())
    return _default[0]
