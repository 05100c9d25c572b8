"""What commands on large scenes take: `python -m tests.benchmarks.large FILE --splats 1000000`.

FILE, a trained scene, is tiled into so many splats; then each command runs in a process of its own:
seconds of its processor time, the most memory that the operating system counted for it (VmHWM:
mapped files too), and bytes written. First all of them run on a small scene, and what they wrote is
read and compared. Every file is deleted as soon as no command needs it.
"""

from __future__ import annotations

import argparse
import json
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from stages import formats
from stages.formats.ply_header import binary_rows, read_header
from stages.proof.checks import read_back
from stages.proof.compare import differences
from tests import processes
from tests.benchmarks import tiled
from tests.benchmarks.timing import machine

GATE_SPLATS = 70_000
_LOD = "lod/lod-meta.json"
_TURN, _TIMES = "0,1,0:90", 0.5  # a quarter turn: x -> -z, z -> x, which the gate says by itself
_MEASURED = """
import json, os, sys
from pathlib import Path
from splatcli.app import app
app(sys.argv[2:], standalone_mode=False)
words = Path("/proc/self/status").read_text().split()
found = {"mib": int(words[words.index("VmHWM:") + 1]) / 1024, "processor": sum(os.times()[:4])}
Path(sys.argv[1]).write_text(json.dumps(found))
"""


@dataclass(frozen=True)
class Scene:
    """path: a .ply of `count` splats. far: the x that three quarters of them lie below."""

    path: Path
    count: int
    far: float

    @classmethod
    def of(cls, source: Path, count: int, folder: Path, degree: int | None) -> Scene:
        path = folder / "scene.ply"
        tiled.main(source, count, path, degree)
        with path.open("rb") as file:
            rows: Any = binary_rows(path, read_header(file), "vertex")
        return cls(path, count, float(np.quantile(rows["x"][::97], 0.75)))


@dataclass(frozen=True)
class Job:
    """words: of the command; `out` is the file that it writes, in the scene's folder, if any."""

    name: str
    words: Callable[[Scene], Sequence[str]]
    out: str = ""
    source: str = "scene.ply"


def _crop(scene: Scene) -> str:
    return f"box:-1e9,-1e9,-1e9,{scene.far},1e9,1e9"


def _half(scene: Scene) -> float:
    return scene.path.stat().st_size / 2e6


JOBS = (
    Job(
        "crop, rotate, scale",
        lambda s: ("edit", "--crop", _crop(s), "--rotate", _TURN, "--scale", str(_TIMES)),
        "moved.ply",
    ),
    Job("decimate 25%", lambda s: ("edit", "--decimate", "25%"), "fewer.ply"),
    Job("levels, streamed", lambda s: ("edit",), _LOD),
    Job("streamed: info", lambda s: ("info", "--json"), source=_LOD),
    Job("streamed: view", lambda s: ("view", "--no-open"), source=_LOD),
    Job("info", lambda s: ("info", "--json")),
    Job("convert to splat", lambda s: ("convert",), "a.splat"),
    Job("convert to sog", lambda s: ("convert",), "a.sog"),
    Job("streamed: convert to ply", lambda s: ("convert",), "back.ply", source=_LOD),
    Job("max-mb, half", lambda s: ("edit", "--max-mb", str(_half(s))), "small.ply"),
)


def done(job: Job, scene: Scene) -> dict[str, Any]:
    """Runs it: mib, processor (seconds), and what the command said last of what it did."""
    folder = scene.path.parent
    verb, *options = job.words(scene)
    files = [str(folder / name) for name in (job.source, job.out) if name]
    more = ["--json"] if verb in ("edit", "convert") else []
    measured = folder / "measured.json"
    command = processes.python(_MEASURED, str(measured), verb, *files, *options, *more)
    with processes.running(command, stderr=subprocess.PIPE, preexec_fn=_hears_ctrl_c) as process:
        if verb == "view":
            processes.line_of(process)  # its address: the page is there
            process.send_signal(signal.SIGINT)
        out, err = process.communicate()
    if process.returncode:
        sys.exit(f"{job.name}: {err}")
    found = json.loads(measured.read_text())
    measured.unlink()
    return found | (json.loads(out.splitlines()[-1]) if verb != "view" else {})


def _hears_ctrl_c() -> None:
    """Also where this script runs in a shell's background, which ignores it."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def written(job: Job, scene: Scene) -> int:
    out = scene.path.parent / job.out
    return formats.format_of(out).size_bytes(out) if job.out else 0


def cleared(job: Job, scene: Scene) -> None:
    """Away with what the job wrote, unless jobs that follow read it."""
    if job.out and job.out != _LOD:
        (scene.path.parent / job.out).unlink()


def check(source: Path, folder: Path) -> None:
    """Exit with what is wrong, if anything is."""
    scene = Scene.of(source, GATE_SPLATS, folder, None)
    whole = formats.read(scene.path)
    for job in JOBS:
        said = done(job, scene)
        out = folder / job.out
        wrong: object = None
        if job.out == "moved.ply":
            inside = whole.means[whole.means[:, 0] <= np.float32(scene.far)]
            wanted = _TIMES * np.stack([inside[:, 2], inside[:, 1], -inside[:, 0]], axis=1)
            found = formats.read(out).means
            wrong = found.shape != wanted.shape or np.abs(found - wanted).max() > 1e-4
        elif job.out == "fewer.ply":
            wrong = len(formats.read(out)) != GATE_SPLATS // 4
        elif job.out == "small.ply":
            wrong = not 0.95 < out.stat().st_size / 1e6 / _half(scene) <= 1
        elif job.out in (_LOD, "back.ply"):
            wrong = differences(whole, read_back(out), "lod-meta.json").wrong
        elif said.get("splats", GATE_SPLATS) != GATE_SPLATS:
            wrong = said
        if wrong:
            sys.exit(f"gate: {job.name}: {wrong}")
    shutil.rmtree(folder / "lod")
    print("gate: every command wrote what it should")


def measure(scene: Scene, jobs: Sequence[Job]) -> None:
    for job in jobs:
        found = done(job, scene)
        mb = f"{written(job, scene) / 1e6:,.0f}" if job.out else ""
        print(
            f"| {scene.count:,} | {job.name} | {found['processor']:,.0f} | {found['mib']:,.0f} | "
            f"{mb} | {found.get('splats', scene.count):,} |",
            flush=True,
        )
        cleared(job, scene)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("file", type=Path)
    parser.add_argument("--splats", type=int, action="append")
    parser.add_argument("--degree", type=int, help="of view-dependent colour; as in FILE")
    parser.add_argument("--job", action="append", choices=[job.name for job in JOBS])
    parser.add_argument("--folder", type=Path, default=Path(), help="with room for it all")
    options = parser.parse_args()
    jobs = [job for job in JOBS if not options.job or job.name in options.job]
    with tempfile.TemporaryDirectory(dir=options.folder, prefix="splat-bench-") as folder:
        check(options.file, Path(folder))
    print(machine())
    print("| splats | command | processor, s | peak, MiB | written, MB | splats after |")
    print("|--:|---|--:|--:|--:|--:|")
    for count in options.splats or [1_000_000]:
        with tempfile.TemporaryDirectory(dir=options.folder, prefix="splat-bench-") as folder:
            measure(Scene.of(options.file, count, Path(folder), options.degree), jobs)


if __name__ == "__main__":
    main()
