"""Kernels are compiled while photographs are read and placed, by a process beside the run."""

from __future__ import annotations

import os
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

from stages.base import threads
from stages.base.stage import Stage
from stages.run.pipeline import Listener

_BEFORE = ("ingest", "sfm", "seed")  # stages that draw nothing
_PATIENCE_S = 300.0
_LAST = "gather_contributions"  # of the kernels, see `training.warm`


class PrecompileListener(Listener):
    """Starts the process with the first stage, and waits for it before anything is drawn: two
    processes must not compile the same. Whatever becomes of it, the run goes on and compiles what
    is missing. backend: that the run will train with.

    Compiling takes one core for as long as 20 photographs are placed and seeded on the other; it is
    as urgent as that, because training waits for both.
    """

    def __init__(self, backend: str) -> None:
        self._backend = backend
        self._process: subprocess.Popen[bytes] | None = None

    def started(self, stage: Stage, number: int, reason: str, resumed: bool) -> None:
        if stage.name not in _BEFORE:
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
        from stages.raster.kernels import cache  # which makes a folder

        if cache.are_compiled(_LAST):
            return
        root = str(Path(__file__).resolve().parents[1])
        paths = os.pathsep.join([root, *filter(None, [os.environ.get("PYTHONPATH")])])
        with suppress(OSError):  # then training compiles, as it always could
            self._process = subprocess.Popen(
                # -P: the current folder may hold anything, also a file named numpy.py.
                [sys.executable, "-P", "-m", "stages.training.compile_kernels", self._backend],
                stdin=subprocess.PIPE,  # it ends when this does
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                env=os.environ | {"PYTHONPATH": paths},
                start_new_session=True,  # Ctrl-C goes to the run alone
            )

    def _wait(self) -> None:
        process = self._process
        if process is None:
            return
        try:
            process.wait(_PATIENCE_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        if process.stdin is not None:
            process.stdin.close()
        self._process = None
