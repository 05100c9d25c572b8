"""Runs one layer's inputs in a child process and turns its end into a row or a failure."""

from __future__ import annotations

import json
import shutil
import subprocess
import tempfile
from pathlib import Path

from tests import processes
from tests.fuzz.child import Tally
from tests.fuzz.layers import LAYERS

SECONDS = 60.0  # to start, and ...
SECONDS_EACH = 1.0  # ... for each input, on a busy machine
SECONDS_EACH_PROCESS = 12.0


class BeatenError(AssertionError):
    """A reader crashed, hung, took too much memory or raised what is not its error."""


def fuzz(name: str, inputs: int) -> Tally:
    """Try `inputs` (or the layer's share of them). Raises BeatenError; the input is kept then."""
    layer = LAYERS[name]
    count = max(10, round(inputs * layer.share))
    each = SECONDS_EACH if layer.share == 1 else SECONDS_EACH_PROCESS
    with tempfile.TemporaryDirectory() as folder:
        command = processes.module("tests.fuzz.child", name, str(count), folder)
        try:
            child = subprocess.run(
                command,
                capture_output=True,
                text=True,
                timeout=SECONDS + each * count,
                check=False,
            )
        except subprocess.TimeoutExpired:
            raise BeatenError(f"{name}: hangs on {_kept(Path(folder), layer.name)}") from None
        if child.returncode != 0:
            kept = _kept(Path(folder), layer.name)
            said = "\n".join(child.stderr.splitlines()[-25:])
            raise BeatenError(f"{name}: status {child.returncode}, input {kept}\n{said}")
    return Tally(**json.loads(child.stdout.splitlines()[-1]))


def _kept(folder: Path, name: str) -> Path:
    """The input that was being read, copied to where it stays."""
    kept = Path(tempfile.mkdtemp(prefix="splat-fuzz-"))
    shutil.copytree(folder, kept, dirs_exist_ok=True)
    return kept / name
