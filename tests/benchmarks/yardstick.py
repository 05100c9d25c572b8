"""The C++ kernel that says how fast this processor can blend; built when it is asked for."""

from __future__ import annotations

import ctypes
import subprocess
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stages.raster.cpu import Forward
from stages.raster.pool import Pool
from stages.raster.projection import GL
from tests.benchmarks.timing import Job

SOURCE = Path(__file__).with_name("yardstick.cpp")
FLAGS = ("-O3", "-march=native", "-shared", "-fPIC", "-pthread")


class Yardstick:
    """Raises FileNotFoundError where there is no g++."""

    def __init__(self) -> None:
        self._folder = tempfile.TemporaryDirectory()
        library = Path(self._folder.name) / "yardstick.so"
        subprocess.run(["g++", *FLAGS, "-o", str(library), str(SOURCE)], check=True)
        self._blend = ctypes.CDLL(str(library)).blend
        self._blend.restype = None

    def blend(self, pool: Pool, forward: Forward, image: NDArray[np.float32]) -> Job:
        """A job that draws the lists of `forward` into image [4, H, W], with the pool's threads."""
        geometry = forward.geometry.copy()
        geometry[:, GL] = np.exp2(geometry[:, GL])  # the opacity itself, as the kernel wants it
        lists = forward.lists
        arrays = [
            *(lists.starts.copy(), lists.members.copy(), lists.spans.copy(), geometry),
            *(forward.paint.copy(), forward.background, image),
        ]
        pointers = [array.ctypes.data_as(ctypes.c_void_p) for array in arrays]
        width, height = forward.width, forward.height

        def job() -> None:
            self._blend(pool.n_threads, width, height, *pointers)
            _ = arrays  # which the pointers point into

        return job
