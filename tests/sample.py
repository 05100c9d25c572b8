"""The command as a process of its own, on the sample capture, with settings that end soon."""

from __future__ import annotations

import json
import shutil
import subprocess
import time
from pathlib import Path
from typing import Any

from tests import processes

PHOTOS = processes.ROOT / "sample_captures" / "still_life" / "images"
PHOTO_COUNT = 24
FORMATS = ("ply", "splat", "glb", "gltf", "usda", "usdc", "usdz")
SMALL = ("--preset", "preview", "--train-side", "160", "--steps", "600")
TOLD, _ELAPSED = "events.jsonl", "elapsed.txt"
PSNR_DB = (22.4, 24.2)
"""Of the three photographs that training never saw. Measured: 23.2 to 23.6 with four seeds and on
two processors. Trained on, the same three have 24.9 with each of three seeds: more than 24.2 would
mean that they were seen."""


def splat(*words: str, folder: Path, timeout_s: float = 600) -> subprocess.CompletedProcess[str]:
    """Run `splat WORDS` in `folder`; its output is kept, whatever its exit status."""
    return subprocess.run(
        processes.splat(*words),
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=timeout_s,
        check=False,
    )


def events(done: subprocess.CompletedProcess[str]) -> list[dict[str, Any]]:
    """The lines that --json printed."""
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-4000:]
    return [json.loads(line) for line in done.stdout.splitlines()]


def process_words(*more: str, photos: Path | str = PHOTOS, max_splats: int = 8000) -> list[str]:
    """The whole pipeline on the sample capture into run/, with small settings."""
    return ["process", str(photos), "--out", "run", *SMALL, f"--max-splats={max_splats}", *more]


def make(folder: Path) -> None:
    """The whole pipeline in every one of FORMATS into `folder`/run; what it told is kept."""
    shutil.rmtree(folder, ignore_errors=True)  # what an attempt that failed left
    folder.mkdir()
    formats = [word for name in FORMATS for word in ("--format", name)]
    start = time.monotonic()
    done = splat(*process_words(*formats, "--json"), folder=folder)
    (folder / _ELAPSED).write_text(str(time.monotonic() - start))
    events(done)
    (folder / TOLD).write_text(done.stdout)


def told(folder: Path) -> list[dict[str, Any]]:
    """The events of the run that `make` made."""
    return [json.loads(line) for line in (folder / TOLD).read_text().splitlines()]


def elapsed_s(folder: Path) -> float:
    """How long `make` waited for it."""
    return float((folder / _ELAPSED).read_text())


def copied(folder: Path, target: Path) -> Path:
    """`target`, with a copy of the run in `folder` as target/run."""
    shutil.copytree(folder / "run", target / "run")
    return target
