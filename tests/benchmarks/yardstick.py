"""The C++ kernel that says how fast this processor can blend; built when it is asked for."""

from __future__ import annotations

import ctypes
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.raster.cpu.binning import TILE
from stages.raster.cpu.projection import (
    GA,
    GB,
    GK,
    GL,
    GVX,
    GVY,
    GX,
    GY,
)
from stages.raster.cpu.rasteriser import Forward
from stages.raster.kernels.pool import Pool
from stages.raster.kernels.simd import kernel
from tests.benchmarks.timing import Job

COMPILER = os.environ.get("SPLAT_CXX")
SOURCE = Path(__file__).with_name("yardstick.cpp")
FLAGS = ("-O3", "-march=native", "-shared", "-fPIC", "-pthread")


@kernel
def row_spans(width, starts, members, geometry, spans):
    """spans [I]: first + 16 x last of the pixel rows in which a splat reaches 1/255, 1 (no rows)
    where it does so in none: what a kernel that goes by rows wants to know."""
    tiles_x = (width + TILE - 1) // TILE
    for tile in range(len(starts) - 1):
        left, top = tile % tiles_x * TILE + 0.5, tile // tiles_x * TILE + 0.5
        for entry in range(starts[tile], starts[tile + 1]):
            row = members[entry]
            wide = geometry[row, GVX] >= geometry[row, GVY]
            reach = (geometry[row, GL] + np.log2(255.0)) * 1.0001
            first, last = 1, 0
            for j in range(TILE):
                for i in range(TILE):
                    dx, dy = left + i - geometry[row, GX], top + j - geometry[row, GY]
                    u, t = (dx, dy) if wide else (dy, dx)
                    t -= geometry[row, GK] * u
                    if (geometry[row, GA] * u) ** 2 + (geometry[row, GB] * t) ** 2 <= reach:
                        first, last = (j if last < first else first), j
            spans[entry] = first + 16 * last


class Yardstick:
    """Exits where SPLAT_CXX names no C++ compiler: one that happens to be there would make the
    figures depend on what else is installed."""

    def __init__(self) -> None:
        if COMPILER is None:
            sys.exit("SPLAT_CXX must name a C++ compiler (g++, say) to build the yardstick with")
        self._folder = tempfile.TemporaryDirectory()
        library = Path(self._folder.name) / "yardstick.so"
        subprocess.run([COMPILER, *FLAGS, "-o", str(library), str(SOURCE)], check=True)
        self._blend = ctypes.CDLL(str(library)).blend
        self._blend.restype = None

    def blend(self, pool: Pool, forward: Forward, image: NDArray[np.float32]) -> Job:
        """A job that draws the lists of `forward` into image [4, H, W], with the pool's threads."""
        tiles = forward.tiles
        geometry = tiles.geometry.copy()
        # the opacity itself and the exponent to base e, as the kernel wants them
        geometry[:, GL] = np.exp2(geometry[:, GL])
        geometry[:, (GA, GB)] = geometry[:, (GA, GB)] ** 2 * np.log(2.0)
        spans = np.empty(len(tiles.members), np.uint8)
        row_spans(tiles.width, tiles.starts, tiles.members, tiles.geometry, spans)
        arrays: list[NDArray[Any]] = [
            *(tiles.starts.copy(), tiles.members.copy(), spans, geometry),
            *(tiles.paint.copy(), tiles.background, image),
        ]
        pointers = [array.ctypes.data_as(ctypes.c_void_p) for array in arrays]
        width, height = tiles.width, tiles.height

        def job() -> None:
            self._blend(pool.n_threads, width, height, *pointers)
            _ = arrays  # which the pointers point into

        return job
