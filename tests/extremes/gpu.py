"""The rows of the extremes table on a GPU, or by Triton's interpreter where there is none; with
--webgpu by the WebGPU kernels on any adapter.

python -m tests.extremes.gpu [--row 3 --row 4] [--float32 | --webgpu]

A row takes the interpreter seconds or minutes, so what was measured is kept in gpu.json beside
this file, and the table's columns "gpu" and "webgpu" are made of that: with a GPU at hand run this,
then `python -m tests.extremes --write docs/experiments/extremes.md`. --float32: with footprints in
float32, kept apart; what that costs is in docs/experiments/gpu.md.
"""

from __future__ import annotations

import argparse
import functools
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

from stages.raster.backends import backend_of
from stages.raster.definition import RasterSettings, splat_arrays
from stages.scene import Camera, Splats
from tests.extremes.measured import Measured, Row

ONE = ("cpu",)  # what has one implementation, which all backends share
KEPT = Path(__file__).with_name("gpu.json")
DOUBLE, SINGLE, WEBGPU = "float64", "float32", "webgpu"
COLUMNS = {"gpu": DOUBLE, "webgpu": WEBGPU}  # backends, and what is kept of each


def on_gpu(row: Row) -> bool:
    """Whether a row says anything of kernels on a GPU: files and what only the CPU's kernels have
    do not."""
    return row.backends != ONE and row.name != "every_format"


@functools.cache
def kept(real: str = DOUBLE) -> dict[int, list[Measured]]:
    """What was measured, by row."""
    return {
        int(number): [Measured(int(number), *line) for line in entry["numbers"]]
        for number, entry in _read().get(real, {}).items()
    }


def wheres(real: str = DOUBLE) -> list[str]:
    """What measured it."""
    return sorted({entry["where"] for entry in _read().get(real, {}).values()})


def _read() -> dict[str, Any]:
    found: dict[str, Any] = json.loads(KEPT.read_text()) if KEPT.exists() else {}
    return found


def _write(every: dict[str, Any]) -> None:
    """A row a line."""
    parts = []
    for real, column in every.items():
        lines = (f"  {json.dumps(number)}: {json.dumps(entry)}" for number, entry in column.items())
        parts.append(f" {json.dumps(real)}: {{\n" + ",\n".join(lines) + "\n }")
    KEPT.write_text("{\n" + ",\n".join(parts) + "\n}\n")


def keep(row: Row, found: list[Measured], real: str) -> None:
    """Put one row's numbers in the place of those kept before."""
    every = _read()
    numbers = [[m.what, float(f"{m.error:.3g}"), m.bound, m.note] for m in found]
    where = backend_of("webgpu" if real == WEBGPU else "gpu").describe()
    entry = {"where": where, "numbers": numbers}
    column = {**every.get(real, {}), str(row.number): entry}
    every[real] = {number: column[number] for number in sorted(column, key=int)}
    _write(every)


def opacity(backend: str, scene: Splats, view: Camera, settings: RasterSettings) -> float:
    """Of the first splat as the kernels blend it, compensation included."""
    rasteriser: Any = backend_of(backend).create()
    seen = rasteriser.view(view, settings)
    records = rasteriser.draw(rasteriser.scene(splat_arrays(scene)), seen).records
    if backend == "webgpu":
        return float(rasteriser.device.read(records, np.float32, 12)[11])
    from stages.raster.gpu.project import LEVEL

    return float(2.0 ** records[0, LEVEL.value].double())


def in_float32() -> None:
    """From here on, footprints of the backend "gpu" in this process are float32."""
    import triton.language as tl

    from stages.raster.gpu.rasteriser import GpuRasteriser

    GpuRasteriser.__init__.__defaults__ = (None, tl.float32)


def main() -> int:
    """0 if every number measured is within its bound."""
    from tests.extremes.table import ROWS

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--row", type=int, action="append", help="of the table; by default all")
    parser.add_argument("--float32", action="store_true", help="footprints in float32")
    parser.add_argument("--webgpu", action="store_true", help="by the backend webgpu")
    asked = parser.parse_args()
    backend = backend_of("webgpu" if asked.webgpu else "gpu")
    backend.require()
    if asked.float32:
        in_float32()
    real, good = SINGLE if asked.float32 else COLUMNS[backend.name], True
    for row in ROWS:
        if not on_gpu(row) or (asked.row and row.number not in asked.row):
            continue
        found = row.measure(backend.name)
        keep(row, found, real)
        for m in found:
            good &= m.accepted
            bound = "none" if m.bound is None else f"{m.bound:.3g}"
            print(
                f"{row.number:3} {'' if m.accepted else 'FAILS ':6}{m.error:.2g} of {bound}", m.what
            )
        sys.stdout.flush()
    return int(not good)


if __name__ == "__main__":
    sys.exit(main())
