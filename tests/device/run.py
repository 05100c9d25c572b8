"""Measures the GPU backend on a machine that is there for minutes.

python -m tests.device.run N --out FOLDER [--bundle FOLDER] [--part NAME ...] [--seconds S] [--toy]

Run 1 takes at most 7 minutes, run 2 at most 5; `parts` says what they are. Each part is a process
of its own with a limit of its own, and what it has found is in FOLDER before the next begins:
results.json (all figures), log.txt (all that was printed), table.txt (the table that is printed
last), and what parts leave besides. So what fails, hangs or is killed costs its own figures alone.
--part leaves the others out. --toy: a few splats, by Triton's interpreter where there is no GPU.
Wheels in the bundle (see `gather`) are unpacked into a temporary folder first. Nothing is imported
here but the standard library.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import zipfile
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from typing import Any

from tests.device.parts import RUNS, SECONDS, Part

ROOT = Path(__file__).resolve().parents[2]
LEAST_S = 5.0  # with less time left no part is started
LOGGED = 60_000  # last characters of a part's output that are kept
TOY_PATIENCE = 4.0  # by which limits grow where kernels are interpreted


@dataclass
class Started:
    """A part that runs."""

    part: Part
    process: subprocess.Popen[bytes]
    began: float
    ends: float
    ended: float = 0.0

    def poll(self) -> bool:
        """Whether it is over; kills it, and all that it started, at its limit."""
        if not self.ended and self.process.poll() is not None:
            self.ended = time.monotonic()
        if not self.ended and time.monotonic() > self.ends:
            self.kill()
        return bool(self.ended)

    def kill(self) -> None:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait()
        self.ended = time.monotonic()


@dataclass
class Run:
    """A run: where its parts work and what they found."""

    out: Path
    work: Path
    bundle: Path
    toy: bool
    deadline: float
    environment: dict[str, str]
    found: dict[str, Any] = field(default_factory=dict)
    behind: dict[str, Started] = field(default_factory=dict)

    def make(self, parts: list[Part]) -> None:
        """Run the parts; every result is in the folder when this returns or is interrupted."""
        for key, members in groupby(parts, key=lambda part: part.group or part.name):
            group = list(members)
            for name in {part.needs for part in group} & self.behind.keys():
                self._wait([self.behind.pop(name)])
            started = [s for part in group if (s := self._started(part))]
            for one in started:
                if one.part.behind:
                    self.behind[one.part.name] = one
            self._wait([one for one in started if not one.part.behind])
            print(f"-- {key}: {self.deadline - time.monotonic():.0f} s left", flush=True)
        for one in self.behind.values():
            one.kill()
            self._keep(one)

    def _started(self, part: Part) -> Started | None:
        now = time.monotonic()
        limit = part.limit_s * (TOY_PATIENCE if self.toy else 1.0)
        ends = min(now + limit, self.deadline)
        if self.deadline - now < LEAST_S:
            self._note(part, {"ended": "not started: no time left"})
            return None
        words = {"RESULT": str(self._result(part)), "BUNDLE": str(self.bundle)}
        command = [words.get(word, word) for word in part.command(self.toy)]
        folder = self.work / part.name
        folder.mkdir(exist_ok=True)
        try:
            with (self.work / f"{part.name}.log").open("wb") as log:
                process = subprocess.Popen(
                    command,
                    cwd=ROOT,
                    env=self.environment | {"SPLAT_DEVICE_OUT": str(self.out)},
                    stdin=subprocess.DEVNULL,
                    stdout=log,
                    stderr=subprocess.STDOUT,
                    start_new_session=True,
                )
        except OSError as error:
            self._note(part, {"ended": f"not started: {error}"})
            return None
        return Started(part, process, now, ends)

    def _wait(self, started: list[Started]) -> None:
        left = list(started)
        while left:
            for one in [s for s in left if s.poll()]:
                left.remove(one)
                self._keep(one)
            for one in self.behind.values():
                one.poll()
            time.sleep(0.05)

    def _result(self, part: Part) -> Path:
        return self.work / f"{part.name}.json"

    def _keep(self, one: Started) -> None:
        """Put what a part found and printed into the folder."""
        status = one.process.returncode
        killed = one.ended >= one.ends
        said = "killed at its limit" if killed else f"exit status {status}" if status else "done"
        found: dict[str, Any] = {}
        with contextlib.suppress(OSError, ValueError):
            found = json.loads(self._result(one.part).read_text())
        found |= {"ended": said, "seconds": round(one.ended - one.began, 1)}
        self._note(one.part, found)

    def _note(self, part: Part, found: dict[str, Any]) -> None:
        self.found[part.name] = found
        print(f"{part.name}: {found['ended']}, {found.get('seconds', 0)} s", flush=True)
        (self.out / "results.json").write_text(json.dumps(self.found, indent=1))
        log = self.work / f"{part.name}.log"
        text = log.read_text(errors="replace")[-LOGGED:] if log.exists() else ""
        with (self.out / "log.txt").open("a") as file:
            file.write(f"\n===== {part.name}: {found['ended']}\n{text}\n")
        (self.out / "table.txt").write_text(self.table())

    def table(self) -> str:
        """What every part found, in lines."""
        lines = []
        for name, found in self.found.items():
            lines.append(f"{name} ({found['ended']}, {found.get('seconds', 0)} s)")
            for what, value, target in found.get("table", ()):
                lines.append(f"  {what:<46} {value}" + (f"   [{target}]" if target else ""))
            if found["ended"] != "done":
                log = self.work / f"{name}.log"
                tail = log.read_text(errors="replace").splitlines()[-3:] if log.exists() else ()
                lines += [f"    | {line[:150]}" for line in tail]
        return "\n".join(lines) + "\n"


def unpacked(bundle: Path, work: Path) -> list[str]:
    """The folder with the bundle's packages that fit this Python. A wheel is an archive: unpacking
    needs no pip, and one that is damaged costs no other."""
    site, python = work / "site", f"cp{sys.version_info.major}{sys.version_info.minor}"
    for path in sorted((bundle / "wheels").glob("*.whl")):
        tags = path.stem.split("-")[-3:]
        if python in tags[0] or "py3" in tags[0] or tags[1] == "abi3":
            try:
                zipfile.ZipFile(path).extractall(site)
            except (OSError, zipfile.BadZipFile) as error:
                print(f"{path.name}: {error}", flush=True)
    return [str(site)] if site.exists() else []


def environment(bundle: Path, work: Path, toy: bool) -> dict[str, str]:
    """Of all parts: this checkout first, then the bundle's packages; one cache of kernels."""
    kept = {name: value for name, value in os.environ.items() if name != "TRITON_INTERPRET"}
    path = [str(ROOT), *unpacked(bundle, work), *filter(None, [kept.get("PYTHONPATH", "")])]
    given = {
        "PYTHONPATH": os.pathsep.join(path),
        "PYTHONUNBUFFERED": "1",
        "OMP_WAIT_POLICY": "passive",
        "TRITON_CACHE_DIR": str(work / "triton"),
    }
    if toy and not any(Path(name).exists() for name in ("/dev/nvidia0", "/dev/kfd")):
        given["TRITON_INTERPRET"] = "1"
    return kept | {name: value for name, value in given.items() if value}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("number", type=int, choices=sorted(RUNS))
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--bundle", type=Path, default=ROOT / ".device")
    parser.add_argument("--part", action="append", help="by default all")
    parser.add_argument("--seconds", type=float, default=0.0, help="of the whole run")
    parser.add_argument("--toy", action="store_true", help="a few splats, also without a GPU")
    asked = parser.parse_args()
    began, parts = time.monotonic(), list(RUNS[asked.number])
    unknown = set(asked.part or ()) - {part.name for part in parts}
    if unknown:
        parser.error(f"run {asked.number} has no part {', '.join(sorted(unknown))}")
    if asked.part:
        parts = [part for part in parts if part.name in asked.part]
    seconds = asked.seconds or SECONDS[asked.number] * (TOY_PATIENCE if asked.toy else 1.0)
    out, bundle = asked.out.resolve(), asked.bundle.resolve()
    out.mkdir(parents=True, exist_ok=True)
    work = Path(tempfile.mkdtemp(prefix="splat-device-"))
    run = Run(out, work, bundle, asked.toy, began + seconds, environment(bundle, work, asked.toy))
    try:
        run.make(parts)
    finally:
        for one in run.behind.values():
            one.kill()
        print(f"\n{run.table()}", flush=True)
        shutil.rmtree(work, ignore_errors=True)


if __name__ == "__main__":
    main()
