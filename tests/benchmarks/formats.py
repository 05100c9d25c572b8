"""What each file format costs: `python -m tests.benchmarks.formats --splats 1000000`.

Nothing is timed before every format has been written, read back by a parser that did not write it,
and found to hold the same splats. Each format is then written and read in a process of its own:
seconds per million splats, bytes a splat, and the most memory beyond the splats' own arrays.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from rich.console import Console
from rich.table import Table

from stages import formats
from stages.base.memory import PeakMemory, resident_mib
from stages.proof.checks import read_back
from stages.proof.compare import differences
from stages.scene import Splats, load_splats, save_splats
from tests import processes
from tests.benchmarks.scenes import random_scene, view
from tests.benchmarks.timing import machine

GATE_SPLATS = 5_000
MIB = 1 << 20
console = Console(width=120)


def check_formats(names: list[str]) -> None:
    """Exit with what differs, if anything does."""
    splats = scene(GATE_SPLATS)
    with tempfile.TemporaryDirectory(prefix="splat-bench-") as folder:
        for name in names:
            path = Path(folder) / f"gate.{name}"
            dropped = formats.write(path, splats)
            found = differences(splats, read_back(path), name)
            own = formats.read(path)
            if dropped or found.wrong or len(own) != len(splats):
                sys.exit(f"gate: .{name} holds other splats: {found.wrong or dropped}")
    print(f"gate: {len(names)} formats hold what was written")


def scene(count: int) -> Splats:
    return random_scene(count, view(1920, 1080), degree=3)


def arrays_mib(splats: Splats) -> float:
    names = ("means", "quaternions", "log_scales", "opacity_logits", "sh", "sh_degrees")
    return sum(getattr(splats, name).nbytes for name in names) / MIB


def write_alone(source: Path, target: Path) -> dict[str, float]:
    """In a process of its own: `beyond` is the memory on top of the splats that are written."""
    splats = load_splats(source)
    before, begun = resident_mib(), time.perf_counter()
    with PeakMemory(0.02) as memory:
        formats.write(target, splats)
    return {"seconds": time.perf_counter() - begun, "beyond": memory.peak_mib - before}


def read_alone(target: Path) -> dict[str, float]:
    """In a process of its own: `beyond` is the memory on top of the splats that come out."""
    before, begun = resident_mib(), time.perf_counter()
    with PeakMemory(0.02) as memory:
        splats = formats.read(target)
    seconds = time.perf_counter() - begun
    return {"seconds": seconds, "beyond": memory.peak_mib - before - arrays_mib(splats)}


def in_a_process(*words: str) -> dict[str, float]:
    command = processes.module("tests.benchmarks.formats", *words)
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        sys.exit(done.stderr)
    return dict(json.loads(done.stdout))


def measure(count: int, names: list[str]) -> None:
    table = Table(
        *("format", "write s/M", "read s/M", "bytes/splat", "write MiB beyond", "read MiB beyond"),
        title=f"{count:,} splats of degree 3",
    )
    splats = scene(count)
    console.print(f"the arrays of the splats take {arrays_mib(splats):,.0f} MiB")
    with tempfile.TemporaryDirectory(prefix="splat-bench-") as folder:
        source = save_splats(Path(folder) / "splats.bin", splats)
        del splats
        for name in names:
            target = Path(folder) / f"a.{name}"
            written = in_a_process("--write", str(source), str(target))
            read = in_a_process("--read", str(target))
            files = [path for path in Path(folder).iterdir() if path != source]
            size = sum(path.stat().st_size for path in files)
            table.add_row(
                name,
                *(f"{1e6 * which['seconds'] / count:.1f}" for which in (written, read)),
                f"{size / count:.1f}",
                *(f"{which['beyond']:,.0f}" for which in (written, read)),
            )
            for path in files:
                path.unlink()
    console.print(table)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--splats", type=int, default=1_000_000)
    parser.add_argument("--format", action="append", choices=list(formats.FORMATS), default=[])
    parser.add_argument("--write", nargs=2, type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--read", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.write:
        print(json.dumps(write_alone(*options.write)))
    elif options.read:
        print(json.dumps(read_alone(options.read)))
    else:
        names = options.format or list(formats.FORMATS)
        check_formats(names)
        console.print(machine())
        measure(options.splats, names)


if __name__ == "__main__":
    main()
