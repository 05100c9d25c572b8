"""The benchmarks run, and their gates hold; nothing is asserted about time."""

from __future__ import annotations

import json
import subprocess
import sys
from types import SimpleNamespace

import pytest

from tests import processes
from tests.benchmarks.yardstick import COMPILER

pytestmark = pytest.mark.slow


def run(*words: str) -> str:
    done = subprocess.run(processes.module(*words), capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_the_step_benchmark_passes_its_gate_and_prints_every_kernel():
    printed = run("tests.benchmarks.step", "--quick")
    assert "a step moves the splats as the reference's step does" in printed
    for kernel in ("project_splats", "blend_tiles", "loss_strips", "move_splats"):
        assert kernel in printed


@pytest.mark.skipif(COMPILER is None, reason="SPLAT_CXX names no C++ compiler for the yardstick")
def test_the_raster_benchmark_draws_what_its_yardstick_draws():
    assert "1,000 at 1920x1080" in run("tests.benchmarks.raster", "--largest", "1000")


def test_the_format_benchmark_passes_its_gate_and_prints_each_format():
    names = ("ply", "glb", "spz")
    wanted = [word for name in names for word in ("--format", name)]
    printed = run("tests.benchmarks.formats", "--splats", "2000", *wanted)
    assert "hold what was written" in printed
    for name in names:
        assert name in printed


def test_the_gpu_benchmark_times_gsplat_beside_it_where_that_is_there(monkeypatch):
    """Whose rasteriser is played here by colours times opacities."""
    pytest.importorskip("triton")
    from tests.benchmarks import gpu

    def rasterization(means, quats, scales, opacities, colors, poses, lenses, width, height, **how):
        assert how.keys() == {"near_plane", "sh_degree", "packed"}
        assert (scales > 0).all()
        picture = (colors[:, 0] * opacities[:, None]).mean(0).expand(1, height, width, 3)
        return picture, None, {}

    monkeypatch.setitem(sys.modules, "gsplat", SimpleNamespace(rasterization=rasterization))
    where = gpu.view(32, 24)
    found = gpu.theirs(gpu.random_scene(12, where, degree=3), where, 1, packed=True)
    assert found.keys() >= {"draw_ms", "both_ms", "step_ms"}


def test_the_gpu_benchmark_passes_its_gate_and_writes_its_figures(tmp_path):
    pytest.importorskip("triton")
    out = tmp_path / "gpu.json"
    printed = run("tests.benchmarks.gpu", "--toy", "--out", str(out))
    assert "gate: pictures and gradients agree with the reference" in printed
    (line,) = json.loads(out.read_text())["lines"]
    assert line["splats"] == 12
    assert line["entries"] > 0
    assert "32x24" in printed  # the table
    assert min(line[name] for name in ("draw_ms", "both_ms", "step_ms", "floor_ms")) > 0
