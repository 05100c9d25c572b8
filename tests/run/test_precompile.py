"""Kernels are compiled beside the first stages, and never at the cost of the run."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from stages.raster.kernels import cache
from stages.run.precompile import PrecompileListener
from stages.run.stages import STAGE_OF
from tests import processes

# What training, pruning and judging still compile.
MISSING = """
import sys
from pathlib import Path
from numba.core import event
from stages.raster.kernels import cache

names = set()

class Heard(event.Listener):
    def on_start(self, told):
        function = told.data["dispatcher"].py_func
        if function.__module__.startswith("stages."):
            names.add(function.__name__)

    def on_end(self, told):
        pass

event.register("numba:compile", Heard())
from stages.prune.settings import PruneSettings
from stages.prune import stage as prune
from stages.train.settings import TrainSettings
from stages.train import stage as train
from stages.base.stage import Report
from tests.small_scene import small_scene

folder = Path(sys.argv[1])
scene = small_scene(folder)
inputs = {"sfm": scene.reconstruction, "seed": scene.splats}
settings = TrainSettings(steps=60, train_side=72, max_splats=400, backend="cpu")
inputs["train"] = train.run(inputs, settings, folder, Report())
prune.run(inputs, PruneSettings(), folder, Report())
print(sorted(names))
"""


@pytest.fixture
def busy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> PrecompileListener:
    """With a helper that has begun, and does not come to an end by itself."""
    program = tmp_path / "python"
    program.write_text("#!/bin/sh\nexec sleep 600\n")
    program.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(program))
    monkeypatch.setattr(cache, "are_compiled", lambda kernel: False)
    monkeypatch.setenv("SPLAT_THREADS", "2")
    compiling = PrecompileListener("cpu")
    begin(compiling, "ingest")
    return compiling


def begin(compiling: PrecompileListener, stage: str) -> None:
    compiling.started(STAGE_OF[stage], 1, "", False)


def helper(compiling: PrecompileListener) -> subprocess.Popen[bytes]:
    process = compiling._process
    assert process is not None
    return process


def test_stages_that_draw_nothing_do_not_wait(busy: PrecompileListener) -> None:
    process = helper(busy)
    for stage in ("sfm", "seed"):
        begin(busy, stage)
        assert helper(busy) is process
        assert process.poll() is None
    busy.ended()


def test_a_helper_that_does_not_end_is_ended(
    busy: PrecompileListener, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("stages.run.precompile._TIMEOUT_S", 0.2)
    process = helper(busy)
    begin(busy, "train")
    assert process.poll() is not None


@pytest.mark.parametrize("how", [PrecompileListener.stopping, PrecompileListener.ended])
def test_it_ends_with_the_run(how: object, busy: PrecompileListener) -> None:
    process = helper(busy)
    assert callable(how)
    how(busy)
    assert process.wait(10) != 0


def test_what_is_compiled_already_is_not_compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cache, "are_compiled", lambda kernel: True)
    monkeypatch.setenv("SPLAT_THREADS", "2")
    compiling = PrecompileListener("cpu")
    begin(compiling, "ingest")
    assert compiling._process is None


def test_a_python_that_cannot_be_started_stops_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "executable", str(tmp_path / "none"))
    monkeypatch.setattr(cache, "are_compiled", lambda kernel: False)
    monkeypatch.setenv("SPLAT_THREADS", "2")
    compiling = PrecompileListener("cpu")
    begin(compiling, "ingest")
    begin(compiling, "train")
    compiling.ended()


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_training_finds_all_its_kernels_compiled(tmp_path: Path) -> None:
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "kernels")}
    warm = processes.module("stages.train.compile_kernels", "cpu")
    with processes.running(warm, env=environment, stdin=subprocess.PIPE) as process:
        assert process.wait(200) == 0
    script = processes.python(MISSING, str(tmp_path))
    done = subprocess.run(script, env=environment, capture_output=True, text=True)
    assert done.stdout.strip() == "[]", done.stdout + done.stderr
