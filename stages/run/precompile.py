"""Compiles kernels in a process beside the first stages, which do not draw."""

from __future__ import annotations

import subprocess
from contextlib import suppress

from stages.base import threads
from stages.base.parent import end_child, python_module, start_child
from stages.base.stage import Stage
from stages.run.pipeline import Listener

_STAGES_WITHOUT_KERNELS = ("ingest", "sfm", "seed")
_TIMEOUT_S = 300.0
_LAST_KERNEL = "gather_contributions"  # compiled last, see `train.compile_kernels`


class PrecompileListener(Listener):
    """Starts the compiling process with the first stage and waits for it before the first stage
    that draws, because two processes must not compile the same kernels.

    The run is correct without it: what the process did not compile is compiled later. Compiling
    takes one core about as long as sfm and seed of 20 photographs take another. It has the same
    priority, because training waits for both.

    backend: the backend that the run will train with.
    """

    def __init__(self, backend: str) -> None:
        self._backend = backend
        self._process: subprocess.Popen[bytes] | None = None

    def started(self, stage: Stage, number: int, reason: str, resumed: bool) -> None:
        if stage.name not in _STAGES_WITHOUT_KERNELS:
            self._wait()
        elif self._process is None and threads.count() > 1:
            self._start()

    def stopping(self) -> None:
        if self._process is not None:
            self._process.kill()

    def ended(self) -> None:
        self.stopping()
        self._wait()

    def _start(self) -> None:
        from stages.raster.kernels import cache  # importing it makes a folder

        if cache.are_compiled(_LAST_KERNEL):
            return
        command = python_module("stages.train.compile_kernels", self._backend)
        with suppress(OSError):
            self._process = start_child(command, subprocess.DEVNULL)

    def _wait(self) -> None:
        process = self._process
        if process is None:
            return
        with suppress(subprocess.TimeoutExpired):
            process.wait(_TIMEOUT_S)
        end_child(process)
        self._process = None
