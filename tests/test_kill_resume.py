"""A run that is killed without warning and resumed ends in the same bytes."""

from __future__ import annotations

import hashlib
import os
import random
import signal
import subprocess
import time
from pathlib import Path

import pytest

from tests.sample import ROOT, command, events, process_words, splat

pytestmark = pytest.mark.slow

KILLS = int(os.environ.get("SPLAT_TEST_KILLS", "4"))
WORDS = process_words("--format", "ply", "--json")


def outputs(run: Path) -> dict[str, str]:
    """SHA-256 of each output file of each stage."""
    return {
        path.relative_to(run).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(run.glob("[1-7]-*/**/*"))
        if path.is_file() and path.name != "manifest.json"
    }


def killed_after(seconds: float, folder: Path) -> bool:
    """Start the run and kill it without warning; False if it ended before that."""
    with (folder / "log").open("a") as log:
        process = subprocess.Popen(
            command(*WORDS),
            cwd=folder,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
            stdout=log,
            stderr=log,
        )
        try:
            process.wait(seconds)
            return False
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGKILL)
            process.wait()
            return True


def test_killed_run_ends_in_the_same_bytes(tmp_path: Path) -> None:
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    whole.mkdir()
    broken.mkdir()
    start = time.monotonic()
    events(splat(*WORDS, folder=whole))
    whole_s = time.monotonic() - start

    moments = random.Random(7)
    finished_before: set[str] = set()
    for _ in range(KILLS):
        if not killed_after(moments.uniform(1.0, 0.6 * whole_s), broken):
            break
        finished = {path.parent.name for path in broken.glob("run/[1-7]-*/manifest.json")}
        assert finished >= finished_before, "what was finished stays finished"
        finished_before = finished
    events(splat(*WORDS, folder=broken))

    assert outputs(broken / "run") == outputs(whole / "run")
    assert any(name.endswith(".ply") for name in outputs(whole / "run"))
    left = [path.name for path in (broken / "run").iterdir() if path.name.startswith(".")]
    assert left == [".lock"]
