"""The extremes table's column "gpu", in several processes; the file of its figures goes beside the
other results."""

from __future__ import annotations

import json
import multiprocessing
import os
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any

from tests.device.results import asked
from tests.extremes import gpu

PROCESSES = 6


def measured(number: int, single: bool) -> list[dict[str, Any]]:
    from tests.extremes.table import ROWS

    if single:
        gpu.in_float32()
    (row,) = (row for row in ROWS if row.number == number)
    return [{**vars(m), "accepted": m.accepted} for m in row.measure("gpu")]


def main() -> None:
    from stages.raster.gpu import device
    from tests.extremes.measured import Measured
    from tests.extremes.table import ROWS

    options, results = asked(__doc__, "--real")
    real, rows = options.real or gpu.DOUBLE, [row for row in ROWS if gpu.on_gpu(row)]
    if out := os.environ.get("SPLAT_DEVICE_OUT"):
        gpu.KEPT = Path(out) / f"extremes-{real}.json"
    chosen = [row for row in rows if not options.toy or row.number == 3]
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(2 if options.toy else PROCESSES, spawn) as pool:
        jobs = {pool.submit(measured, row.number, real == gpu.SINGLE): row for row in chosen}
        for job in as_completed(jobs):
            row = jobs[job]
            with results.attempt(f"row {row.number}"):
                found = job.result()
                gpu.keep(
                    row,
                    [Measured(*(m[k] for k in ("row", "what", "error", "bound"))) for m in found],
                    real,
                )
                for m in found:
                    if not m["accepted"]:
                        results.row(
                            f"row {row.number} FAILS: {m['what']}"[:46], f"{m['error']:.2g}"
                        )
                results.put(f"row {row.number}", json.loads(json.dumps(found, default=float)))
    results.row(f"rows of {real}", f"{len(chosen)} on {device.describe()}")


if __name__ == "__main__":
    main()
