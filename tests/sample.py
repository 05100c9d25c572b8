"""The command as a process of its own, on the sample capture, with settings that end soon."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parent.parent
PHOTOS = ROOT / "sample_captures" / "still_life" / "images"
PHOTO_COUNT = 24
FORMATS = ("ply", "splat", "glb", "gltf", "usda", "usdc", "usdz")
SMALL = ("--preset", "preview", "--train-side", "160", "--steps", "600", "--max-splats", "8000")


def command(*words: str) -> list[str]:
    """`splat WORDS` as a command line."""
    return [sys.executable, "-m", "splatcli", *words]


def environment() -> dict[str, str]:
    """So that the source tree is found from any folder."""
    paths = [str(ROOT), os.environ.get("PYTHONPATH", "")]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, paths))}


def splat(*words: str, folder: Path, timeout_s: float = 600) -> subprocess.CompletedProcess[str]:
    """Run `splat WORDS` in `folder`; its output is kept, whatever its exit status."""
    return subprocess.run(
        command(*words),
        cwd=folder,
        env=environment(),
        capture_output=True,
        text=True,
        timeout=timeout_s,
        check=False,
    )


def events(done: subprocess.CompletedProcess[str]) -> list[dict[str, Any]]:
    """The lines that --json printed."""
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-4000:]
    return [json.loads(line) for line in done.stdout.splitlines()]


def process_words(*more: str) -> list[str]:
    """The whole pipeline on the sample capture into run/, with small settings."""
    return ["process", str(PHOTOS), "--out", "run", *SMALL, *more]
