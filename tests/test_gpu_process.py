"""The whole pipeline on the GPU backend; interpreted where there is no GPU, and little then."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from tests import sample

pytest.importorskip("triton")
pytestmark = [pytest.mark.gpu, pytest.mark.slow, pytest.mark.timeout(900)]

WORDS = ("--steps", "40", "--train-side", "32", "--max-splats", "40", "--backend", "gpu")


def test_a_run_on_the_gpu_backend_ends_with_verified_assets(sample_run: Path, tmp_path: Path):
    shutil.copytree(sample_run / "run", tmp_path / "run")
    # These settings are kept for all later commands: interpreted, a step takes a second.
    few = ("--rounds", "1", "--finetune-steps", "2")
    sample.events(sample.splat("prune", *few, "--json", folder=tmp_path))
    sample.events(sample.splat("quantise", "--plain-steps", "20", "--json", folder=tmp_path))
    formats = ("--format", "ply", "--format", "glb")
    sample.events(sample.splat("process", *WORDS, *formats, "--json", folder=tmp_path))
    metrics = json.loads((tmp_path / "run/4-train/manifest.json").read_text())["metrics"]
    assert metrics["backend"] == "gpu"
    assert "Triton" in metrics["device"]
    assert metrics["unavailable_backends"] == {}
    for name in ("scene.ply", "scene.glb"):
        sample.events(sample.splat("verify", f"run/7-export/{name}", "--json", folder=tmp_path))
