"""A run with the reference backend uses no other, from training to the last verification."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import pytest

from tests import processes
from tests.sample import PHOTOS

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]

_RUN_AND_LOOK = """
import json, sys
from splatcli.app import main
try:
    main()
except SystemExit as end:
    assert not end.code, end.code
loaded = [name for name in sys.modules if name.startswith("stages.raster.cpu.")]
from stages.train.steps.loss_kernels import loss_strips
from stages.train.optimiser import move_splats
called = [k.__name__ for k in (loss_strips, move_splats) if k.signatures]
print(json.dumps({"event": "kernels", "loaded": loaded, "called": called}))
"""
_TINY = (
    *("--train-side", "48", "--steps", "6", "--max-splats", "400", "--preset", "preview"),
    *("--finetune-steps", "1"),
)


def test_the_whole_sample_runs_on_the_reference_without_one_cpu_kernel(tmp_path: Path) -> None:
    words = ["process", str(PHOTOS), "--out", "run", *_TINY, "--backend", "reference"]
    done = subprocess.run(
        processes.python(_RUN_AND_LOOK, *words, "--format", "ply", "--json"),
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-4000:]
    *_, result, kernels = [json.loads(line) for line in done.stdout.splitlines()]
    assert kernels == {"event": "kernels", "loaded": [], "called": []}
    for stage in ("train", "prune", "quantise", "export"):
        assert result["stages"][stage]["metrics"]["backend"] == "reference", stage
