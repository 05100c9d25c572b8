"""Runs inputs of one layer in child processes, and keeps a journal of what became of them."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import tempfile
import threading
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

from tests import processes
from tests.fuzz.child import NUMBER, Tally
from tests.fuzz.cost import ENVIRONMENT
from tests.fuzz.layers import LAYERS

BATCH = 10_000  # inputs of a process; what a killed run repeats
_SECONDS = 120.0  # on the clock, for what waits instead of computing: to start, and ...
_SECONDS_EACH = 0.5  # ... for each input
_WRITING = threading.Lock()


class UntriedError(AssertionError):
    """The child ended before the first input: the layer itself is wrong."""


def fuzz(name: str, inputs: int, kept: Path) -> Iterator[Tally]:
    """The tallies of inputs up to number `inputs` that `kept` does not have yet, batch by batch.
    `kept` holds the journal, and for each layer seeds and the inputs that beat a reader."""
    done = [tally for tally in journal(kept) if tally.layer == name]
    first = max((tally.first + tally.tried for tally in done), default=0)
    while first < inputs:
        tally = _batch(name, first, min(BATCH, inputs - first), kept / slug(name))
        first += tally.tried
        with _WRITING, (kept / "journal.jsonl").open("a") as file:
            file.write(json.dumps(asdict(tally)) + "\n")
        yield tally


def journal(kept: Path) -> list[Tally]:
    """All batches so far; a line that a killed run left incomplete is none."""
    path, found = kept / "journal.jsonl", []
    for line in path.read_text().splitlines() if path.is_file() else ():
        try:
            found.append(Tally(**json.loads(line)))
        except ValueError:
            continue
    return found


def total(tallies: list[Tally]) -> Tally:
    """Of one layer."""
    whole = Tally(tallies[0].layer, 0)
    for part in tallies:
        whole.tried += part.tried
        whole.read += part.read
        whole.refused += part.refused
        if part.cpu_s > whole.cpu_s:
            whole.cpu_s, whole.cpu_input = part.cpu_s, part.cpu_input
        if part.peak_mib > whole.peak_mib:
            whole.peak_mib, whole.peak_input = part.peak_mib, part.peak_input
        whole.beaten += part.beaten
    return whole


def slug(name: str) -> str:
    """The folder of a layer."""
    return re.sub(r"[^\w.]+", "-", name)


def _batch(name: str, first: int, count: int, kept: Path) -> Tally:
    """If the child dies, what it did before counts, and the input that killed it is kept."""
    with tempfile.TemporaryDirectory() as parent:
        folder = Path(parent) / "in"
        folder.mkdir()
        words = (name, str(first), str(count), str(folder), str(kept))
        command = processes.module("tests.fuzz.child", *words)
        limit = _SECONDS + _SECONDS_EACH * count
        try:
            child = subprocess.run(
                command,
                capture_output=True,
                text=True,
                timeout=limit,
                check=False,
                env={**os.environ, **ENVIRONMENT},
            )
        except subprocess.TimeoutExpired:
            why = "it waits for ever"
        else:
            if child.returncode == 0:
                return Tally(**json.loads(child.stdout.splitlines()[-1]))
            why = f"status {child.returncode}: {child.stderr[-500:]}"
        file = Path(f"{folder}.number")
        if not file.is_file():
            raise UntriedError(f"{name}: nothing was tried, {why}")
        (number,) = NUMBER.unpack(file.read_bytes())
        damaged = kept / "beaten" / str(number) / LAYERS[name].name
        damaged.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(folder / LAYERS[name].name, damaged)
        tried = number + 1 - first
        return Tally(name, first, tried, beaten=[[str(damaged), why]], refused=tried - 1)
