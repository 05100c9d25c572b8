"""`python -m tests.fuzz.child LAYER FIRST COUNT FOLDER KEPT`: some inputs, in a process that may
die.

Each input lies in FOLDER while it is read, with its number in FOLDER.number, so that the parent has
both when this process ends badly. Input number n depends on n and on the seeds before it alone.
Seeds are inputs that made a reader take a new step from line to line; KEPT/seeds holds them, and
KEPT/beaten the inputs that beat a reader. The last line of standard output is the tally, as JSON.
"""

from __future__ import annotations

import gc
import json
import os
import struct
import sys
import warnings
from dataclasses import asdict, dataclass, field
from pathlib import Path
from random import Random

from stages.base.errors import SplatError
from stages.ingest.decode import Unusable
from tests.fuzz.arcs import Arcs
from tests.fuzz.changes import damaged
from tests.fuzz.cost import (
    CPU_LIMIT_S,
    OUT_OF_CPU,
    PEAK_LIMIT_MIB,
    Cost,
    Meter,
    in_fork,
    limit_cpu,
    limit_process,
    resident_now_kib,
)
from tests.fuzz.layer import Layer
from tests.fuzz.layers import LAYERS

NUMBER = struct.Struct("<q")
MOST_SEEDS = 300  # all are read again at the start of a batch
_LARGEST_SEED = 8  # times the undamaged content
_FRESH = 0.5  # share of the inputs that are made from the undamaged content


@dataclass
class Tally:
    """Of a batch. cpu_input, peak_input: the number of the input that took most."""

    layer: str
    first: int
    tried: int = 0
    read: int = 0
    refused: int = 0
    cpu_s: float = 0.0
    cpu_input: int = -1
    peak_mib: float = 0.0
    peak_input: int = -1
    beaten: list[list[str]] = field(default_factory=list)  # (file, why)

    def add(self, number: int, cost: Cost) -> None:
        if cost.cpu_s > self.cpu_s:
            self.cpu_s, self.cpu_input = round(cost.cpu_s, 4), number
        if cost.peak_mib > self.peak_mib:
            self.peak_mib, self.peak_input = round(cost.peak_mib, 2), number


def attempt(layer: Layer, path: Path, resident_kib: int) -> tuple[str, Cost]:
    """("read", "refused" or what is wrong; cost) of the file at `path`. resident_kib: before the
    first input."""
    if layer.in_fork:
        status, cost = in_fork(lambda: layer.read(path))
        # The library's crashes are why the reader has a process of its own.
        wrong = "it takes too long" if status == OUT_OF_CPU else ""
        outcome = wrong or ("read" if status == 0 else "refused")
    else:
        limit_cpu()
        meter = Meter(resident_kib)
        try:
            layer.read(path)
            outcome = "read"
        except (SplatError, Unusable) as refusal:
            huge = isinstance(refusal.__cause__, MemoryError)
            outcome = "it believed a huge count" if huge else "refused"
        except Exception as error:
            outcome = f"{type(error).__name__}: {str(error)[:200]}"
        cost = meter.stop()
    if cost.cpu_s > CPU_LIMIT_S:
        outcome = f"it takes {cost.cpu_s:.1f} CPU seconds"
    if cost.peak_mib > PEAK_LIMIT_MIB:
        outcome = f"it takes {cost.peak_mib:.0f} MiB"
    return outcome, cost


def made(number: int, layer: Layer, whole: bytes, seeds: list[bytes]) -> bytes:
    """Input `number`, before it is packed."""
    random = Random(f"{layer.name} {number}")
    fresh = not seeds or random.random() < _FRESH
    return damaged(random, whole if fresh else random.choice(seeds), text=layer.text)


def main(name: str, first: int, count: int, folder: Path, kept: Path) -> None:
    layer = LAYERS[name]
    whole = layer.content()
    for beside, content in layer.beside().items():
        (folder / beside).parent.mkdir(parents=True, exist_ok=True)
        (folder / beside).write_bytes(content)
    path = folder / layer.name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(layer.pack(whole))
    arcs, tally, seeds = Arcs(), Tally(name, first), []
    assert layer.in_fork or layer.read(path) == layer.holds, f"{name}: undamaged, it is refused"
    limit_process()
    for file in sorted((kept / "seeds").glob("*")):
        if int(file.name) < first:
            seeds.append(file.read_bytes())
    with warnings.catch_warnings(), arcs.watching():
        warnings.simplefilter("ignore")
        for content in (whole, *seeds):
            path.write_bytes(layer.pack(content))
            attempt(layer, path, 0)
    gc.collect()
    gc.freeze()  # else a collection of all modules counts as the time of an input
    resident = resident_now_kib()
    at = os.open(f"{folder}.number", os.O_WRONLY | os.O_CREAT)
    for number in range(first, first + count):
        content, known = made(number, layer, whole, seeds), len(arcs)
        os.pwrite(at, NUMBER.pack(number), 0)
        path.write_bytes(layer.pack(content))
        with warnings.catch_warnings(), arcs.watching():
            warnings.simplefilter("ignore")
            outcome, cost = attempt(layer, path, resident)
        tally.tried += 1
        tally.add(number, cost)
        if outcome in ("read", "refused"):
            setattr(tally, outcome, getattr(tally, outcome) + 1)
        else:
            file = kept / "beaten" / str(number) / layer.name
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_bytes(path.read_bytes())
            tally.beaten.append([str(file), outcome])
        small = len(content) <= _LARGEST_SEED * len(whole)
        if len(arcs) > known and len(seeds) < MOST_SEEDS and small:
            seeds.append(content)
            (kept / "seeds").mkdir(parents=True, exist_ok=True)
            (kept / "seeds" / f"{number:09}").write_bytes(content)
    print(json.dumps(asdict(tally)))


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), Path(sys.argv[4]), Path(sys.argv[5]))
