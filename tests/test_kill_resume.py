"""A run that is killed without warning and resumed ends in the same bytes."""

from __future__ import annotations

import hashlib
import json
import os
import random
import shutil
import signal
import subprocess
import time
from pathlib import Path
from typing import Any

import pytest

from tests import processes, sample
from tests.sample import events, process_words

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]

KILLS = int(os.environ.get("SPLAT_TEST_KILLS", "4"))
SEED = int(os.environ.get("SPLAT_TEST_SEED", "4"))
# The cap is what memory allows, and memory is never twice the same.
WORDS = process_words("--format", "ply", "--json", photos="photos", max_splats=0)
PHOTOS = 10  # of the sample capture, enough to be placed
MIB, OTHER_MIB = 40.0, (60.0, 400.0)  # of which the first stops growth early
# Training writes checkpoints by the clock, more seldom than this small run lasts.
IMPATIENT = """
import sys
import stages.base.memory as memory
import stages.train.hooks as hooks

free_mib = float(sys.argv.pop(1))
memory.available_mib = lambda: free_mib
hooks.CHECKPOINT_SECONDS = 0.7
from splatcli.app import main

main()
"""


def outputs(run: Path) -> dict[str, str]:
    """SHA-256 of each output file of each stage."""
    return {
        path.relative_to(run).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(run.glob("[1-7]-*/**/*"))
        if path.is_file() and path.name != "manifest.json"
    }


def finished(run: Path) -> dict[str, int]:
    """Time of the manifest (ns) by finished stage."""
    return {p.parent.name: p.stat().st_mtime_ns for p in run.glob("[1-7]-*/manifest.json")}


def stages_by_seconds(run: Path) -> dict[str, float]:
    """How long each stage took, by the name of its folder."""
    manifests = sorted(run.glob("[1-7]-*/manifest.json"))
    return {path.parent.name: json.loads(path.read_text())["seconds"] for path in manifests}


def command(folder: Path, draw: random.Random) -> list[str]:
    """The run, with other memory than before once training has written a checkpoint. Without one
    it starts again, by the memory there is."""
    run = folder / "run"
    begun = (run / "4-train").is_dir() or any(run.glob(".4-train*/checkpoint.bin"))
    free_mib = draw.uniform(*OTHER_MIB) if begun else MIB
    return processes.python(IMPATIENT, str(free_mib), *WORDS)


def complete(folder: Path, draw: random.Random) -> list[dict[str, Any]]:
    """The events that the run reported until its end."""
    return events(
        subprocess.run(
            command(folder, draw), cwd=folder, capture_output=True, text=True, timeout=600
        )
    )


def stop_in(sign: str, after_s: float, folder: Path, how: int, draw: random.Random) -> int | None:
    """Start the run and send a signal some time after the file or folder `sign` appeared in the
    run folder. Returns its exit status; 0 if it ended before that."""
    with (folder / "log").open("ab") as log:
        process = subprocess.Popen(command(folder, draw), cwd=folder, stdout=log, stderr=log)
    try:
        while not (folder / "run" / sign).exists():
            if process.poll() is not None:
                return process.returncode
            time.sleep(0.005)
        process.wait(after_s)
    except subprocess.TimeoutExpired:
        process.send_signal(how)
        process.wait(120)
    finally:
        if process.poll() is None:
            process.kill()
            process.wait()
    return process.returncode


def test_killed_run_ends_in_the_same_bytes(tmp_path: Path) -> None:
    print(f"SPLAT_TEST_SEED={SEED} SPLAT_TEST_KILLS={KILLS}")  # shown if it fails
    draw = random.Random(SEED)
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    for folder in (whole, broken):
        (folder / "photos").mkdir(parents=True)
        for photo in sorted(sample.PHOTOS.iterdir())[:PHOTOS]:
            shutil.copy(photo, folder / "photos")
    complete(whole, draw)
    seconds = stages_by_seconds(whole / "run")

    names = list(seconds)  # long stages are hit more often, short ones not never
    chosen = draw.choices(names, [seconds[n] + 1.0 for n in names], k=KILLS)
    before: dict[str, int] = {}
    for stage in sorted(chosen):
        moment = draw.uniform(0.0, seconds[stage])
        status = stop_in(f".{stage}.partial", moment, broken, signal.SIGKILL, draw)
        assert status in (-signal.SIGKILL, 0), (broken / "log").read_text()[-3000:]
        now = finished(broken / "run")
        assert before.items() <= now.items(), "what was finished stays finished"
        before = now
    complete(broken, draw)

    assert outputs(broken / "run") == outputs(whole / "run")
    assert any(name.endswith(".ply") for name in outputs(whole / "run"))
    left = [path.name for path in (broken / "run").iterdir() if path.name.startswith(".")]
    assert left == [".lock"]

    after_ctrl_c_training_goes_on(whole, draw)


def after_ctrl_c_training_goes_on(folder: Path, draw: random.Random) -> None:
    """On a run that is finished up to `seed`: Ctrl-C in training, then the same bytes again."""
    run = folder / "run"
    wanted = outputs(run)
    for name in ("4-train", "5-prune", "6-quantise", "7-export"):
        (run / name).rename(folder / f"was {name}")
    sign = ".4-train.partial/checkpoint.bin"
    assert stop_in(sign, 0.0, folder, signal.SIGINT, draw) == 130
    assert '"go_on"' in (folder / "log").read_text().splitlines()[-1]
    done = complete(folder, draw)
    assert [e["resumed"] for e in done if e["event"] == "started"] == [True, False, False, False]
    resumed = next(e for e in done if e["event"] == "finished" and e["stage"] == "train")
    assert resumed["metrics"]["resumed_from_step"] > 0
    assert outputs(run) == wanted
