"""The GPU's kernels against the definition: on a GPU where there is one, else interpreted, on
scenes small enough for that."""

from __future__ import annotations

import importlib.util
import json
import os
import re
import shutil
import subprocess
import sysconfig
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

pytest.importorskip("triton")

from triton.runtime.errors import InterpreterError, OutOfResources

from stages.base.errors import SplatError
from stages.evaluate.contribution import measure_contributions
from stages.evaluate.evaluation import EvaluationView
from stages.raster import backends
from stages.raster.backends import backend_of, rasteriser_of
from stages.raster.definition import RasterSettings, splat_arrays
from stages.raster.draw import renderer
from stages.raster.gpu import device, inner
from stages.raster.gpu.rasteriser import GpuRasteriser
from stages.raster.reference_rasteriser import ReferenceRasteriser
from stages.run import results
from stages.train.settings import TrainSettings
from tests import processes
from tests.extremes.gpu import on_gpu
from tests.extremes.table import ROWS, measured
from tests.scenes import PARAMETERS, camera, cloud, exact_gradients, gradients, relative
from tests.tolerances import FLOAT32_GRADIENT, FLOAT32_IMAGE

pytestmark = pytest.mark.gpu
SETTINGS = RasterSettings(background=(0.2, 0.5, 0.9))
TARGETS = ("cuda:80", "cuda:90", "cuda:100", "hip:gfx942")
COMPILATION_CPU_S = 20.0  # of all kernels and degrees; 12 were measured, 190 before
# Rows of the extremes table that the interpreter does in a second or two. On a GPU all are done.
LIGHT_ROWS = (1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 13, 14, 15, 22, 24, 31)


@pytest.fixture(autouse=True)
def poisoned_memory() -> Iterator[None]:
    """Results must not depend on uninitialised memory: torch fills it with NaN here."""
    torch.use_deterministic_algorithms(True)
    yield
    torch.use_deterministic_algorithms(False)


@pytest.mark.parametrize("tile", [8, 16, 32])
@pytest.mark.parametrize(("size", "antialias"), [((1, 1), False), ((47, 33), True)])
def test_pictures_and_every_gradient_agree(size, antialias, tile):
    scene, view = cloud(60, size[0], size[1], 3), camera(*size)
    settings = RasterSettings(background=(0.2, 0.5, 0.9), antialias=antialias)
    arrays = splat_arrays(scene)
    found, wanted = GpuRasteriser(tile), ReferenceRasteriser()
    a = found.forward(arrays, view, settings, depths=True)
    b = wanted.forward(arrays, view, settings, depths=True)
    np.testing.assert_allclose(a.image[:4], b.image[:4], atol=FLOAT32_IMAGE)
    np.testing.assert_allclose(a.image[4], b.image[4], atol=10 * FLOAT32_IMAGE)
    assert np.isclose(a.image[5], b.image[5], atol=10 * FLOAT32_IMAGE).mean() > 0.999
    np.testing.assert_array_equal(a.visible, b.visible)
    v = np.random.default_rng(1).normal(size=(3, size[1], size[0])).astype(np.float32)
    g, h = found.backward(a, v), wanted.backward(b, v)
    np.testing.assert_array_equal(g.rows, h.rows)
    for first, end in ((0, 3), (3, 7), (7, 10), (10, 11), (11, 59)):
        assert relative(g.parameters[:, first:end], h.parameters[:, first:end]) < FLOAT32_GRADIENT
    assert relative(g.means2d, h.means2d) < FLOAT32_GRADIENT


@pytest.mark.parametrize("degree", [0, 1])
def test_gradients_of_an_active_degree_leave_higher_bands_alone(degree):
    scene, view = cloud(30, 24, 20, degree=2), camera(24, 20)
    v = np.random.default_rng(1).normal(size=(20, 24, 3)).astype(np.float32)
    settings = RasterSettings(sh_degree=degree)
    found = gradients("gpu", scene, view, v, settings)
    wanted = exact_gradients(scene, view, v, settings)
    assert not found["sh"][:, (degree + 1) ** 2 :].any()
    for name in PARAMETERS:
        assert relative(found[name], wanted[name]) < FLOAT32_GRADIENT, name


def test_contributions_agree():
    scene, view = cloud(50, 40, 30, degree=1), camera(40, 30)
    residual = np.random.default_rng(2).normal(size=(3, 30, 40)).astype(np.float32)
    made = []
    for rasteriser in (rasteriser_of("gpu"), rasteriser_of("reference")):
        forward = rasteriser.forward(splat_arrays(scene), view, SETTINGS)
        made.append(rasteriser.contributions(forward, residual))
    for column in range(3):
        assert relative(made[0][:, column], made[1][:, column]) < FLOAT32_GRADIENT


def test_pictures_of_the_same_splats_send_them_once(monkeypatch):
    scene, sent = cloud(20, 40, 30), []
    send = GpuRasteriser.scene

    def counting(self, arrays):
        sent.append(arrays)
        return send(self, arrays)

    monkeypatch.setattr(GpuRasteriser, "scene", counting)
    draw = renderer(scene, SETTINGS, "gpu")
    pictures = [draw(camera(40, 30)).image for _ in range(2)]
    views = [EvaluationView("one", camera(40, 30), np.zeros((30, 40, 3), np.uint8))] * 2
    measure_contributions(scene, views, "gpu", truncation=False)
    assert len(sent) == 2
    np.testing.assert_array_equal(pictures[0], pictures[1])


def test_the_same_twice_is_the_same_bytes():
    scene, view = cloud(40, 40, 30, degree=1), camera(40, 30)
    v = np.random.default_rng(1).normal(size=(3, 30, 40)).astype(np.float32)
    made = []
    for _ in range(2):
        rasteriser = GpuRasteriser(16)
        forward = rasteriser.forward(splat_arrays(scene), view, SETTINGS)
        backward = rasteriser.backward(forward, v)
        made.append((forward.image.tobytes(), backward.parameters.tobytes()))
    assert made[0] == made[1]


def test_equal_depths_are_drawn_in_the_order_of_their_values():
    scene = cloud(30, 40, 30)
    scene.means[:, 2] = 3.0
    scene.means[:15, :2] = scene.means[15:, :2]  # so that opacities decide
    order = np.random.default_rng(3).permutation(30)
    view = camera(40, 30)
    images = [
        GpuRasteriser(16).forward(splat_arrays(s), view, SETTINGS).image
        for s in (scene, scene.take(order))
    ]
    wanted = ReferenceRasteriser().forward(splat_arrays(scene), view, SETTINGS).image
    np.testing.assert_array_equal(images[0], images[1])
    np.testing.assert_allclose(images[0], wanted, atol=FLOAT32_IMAGE)


def test_lists_without_room_draw_what_they_hold_and_say_how_much_it_was():
    scene, view = cloud(40, 40, 30), camera(40, 30)
    rasteriser = GpuRasteriser(16)
    on_device, seen = rasteriser.scene(splat_arrays(scene)), rasteriser.view(view, SETTINGS)
    whole = rasteriser.draw(on_device, seen)
    some = rasteriser.draw(on_device, seen, capacity=10)
    roomy = rasteriser.draw(on_device, seen, capacity=1000)
    assert int(whole.lists.total) == int(some.lists.total) == len(whole.lists.members) > 10
    assert bool(some.image.isfinite().all())
    assert torch.equal(whole.image, roomy.image)


def rows():
    for row in filter(on_gpu, ROWS):
        heavy = device.interpreted() and row.number not in LIGHT_ROWS
        why = "slow, interpreted: python -m tests.extremes.gpu measures it"
        yield pytest.param(row, id=row.name, marks=[pytest.mark.skipif(heavy, reason=why)])


@pytest.mark.slow
@pytest.mark.parametrize("row", list(rows()))
def test_every_number_of_the_table_is_within_its_bound(row):
    beyond = [m for m in measured(row, "gpu") if not m.accepted]
    assert not beyond, "\n".join(f"{m.what}: {m.error:.3g} > {m.bound:.3g}" for m in beyond)


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("target", TARGETS)
def test_every_kernel_compiles_within_its_registers(target):
    """For a GPU that is not here. A warp of blending keeps at most 128 registers a thread, so that
    16 of them live on a multiprocessor, and spills nothing; elsewhere two doubles may spill, as
    projection does on sm_100 (8 bytes)."""
    process = subprocess.run(
        processes.module("tests.raster.gpu_compile", target),
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "TRITON_INTERPRET": "0"},
    )
    assert process.returncode == 0, process.stderr[-2000:]
    found = json.loads(process.stdout)
    assert len(found) == 24
    # a first run waits for it
    assert (
        target != "cuda:90" or sum(taken["cpu_s"] for taken in found.values()) <= COMPILATION_CPU_S
    )
    for name, taken in found.items():
        assert taken["spills"] <= (0 if name.startswith("blend") else 16), (name, taken)
        assert taken["shared"] <= 16 * 1024, (name, taken)
    for name in ("blend_kernel", "blend_gradient_kernel"):
        assert found[name]["registers"] <= 128, (name, found[name])


def test_auto_passes_the_interpreter_over_and_says_why(monkeypatch):
    monkeypatch.setenv("TRITON_INTERPRET", "1")
    assert backend_of("auto").name == "cpu"
    assert "interpreter" in backends.BACKENDS[0].why_unavailable()


@pytest.mark.parametrize(
    ("fault", "said"),
    [
        ("no_triton", "Triton is not installed"),
        ("cpu_build", "built for the CPU alone"),
        ("no_card", "no GPU found"),
        ("old_driver", "NVIDIA's driver 470.42.01 is too old for CUDA 13.0.*580 or newer"),
        ("amd_card", "an AMD card is here, and torch is built for NVIDIA's"),
        ("nvidia_card", "an NVIDIA card is here, and torch is built for AMD's"),
        ("busy_card", "all CUDA-capable devices are busy"),
        ("old_card", r"Old Card \(sm_70\) is too old for torch"),
        ("new_card", r"\(sm_130\) is too old for torch .* or too new: sm_75, sm_90"),
        ("no_compiler", "neither gcc nor clang found"),
        ("other_compiler", "CC names no-such-compiler, which is not there"),
        ("no_headers", "no Python.h in .*: install python3-dev"),
        ("bad_kernel", "a first kernel failed: CalledProcessError: Command 'gcc'"),
        ("next_card", ""),
        ("", ""),
    ],
)
def test_what_is_missing_is_named(fault, said, monkeypatch, tmp_path):
    monkeypatch.delenv("TRITON_INTERPRET", raising=False)
    compiler = {"no_compiler": "", "other_compiler": "no-such-compiler"}.get(fault, "sh")
    monkeypatch.setenv("CC", compiler)
    headers = tmp_path / "include"
    headers.mkdir()
    if fault != "no_headers":
        (headers / "Python.h").touch()
    monkeypatch.setattr(sysconfig, "get_paths", lambda scheme: {"include": str(headers)})
    device._trial.cache_clear()

    def trial():
        if fault == "bad_kernel":
            raise subprocess.CalledProcessError(1, "gcc")

    monkeypatch.setattr("stages.raster.gpu.inner.trial", trial)
    architectures = ["sm_75", "sm_90", "compute_90"]
    if fault == "new_card":
        architectures.pop()
    monkeypatch.setattr(torch.cuda, "get_arch_list", lambda: architectures)
    other = fault in ("cpu_build", "nvidia_card")
    monkeypatch.setattr(torch.version, "cuda", None if other else "13.0")
    monkeypatch.setattr(torch.version, "hip", "7.1" if fault == "nvidia_card" else None)
    unseen = ("no_card", "old_driver", "amd_card", "nvidia_card")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: fault not in unseen)
    nvidia, amd = tmp_path / "version", tmp_path / "kfd"
    monkeypatch.setattr(device, "_NVIDIA", nvidia)
    monkeypatch.setattr(device, "_AMD", amd)
    if fault in ("old_driver", "nvidia_card"):
        nvidia.write_text("NVRM version: NVIDIA UNIX x86_64 Kernel Module  470.42.01  Thu 15")
    if fault == "amd_card":
        amd.write_text("")
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda: "Old Card")
    capability_of = {"old_card": (7, 0), "new_card": (13, 0), "next_card": (9, 3)}

    def capability():
        if fault == "busy_card":
            raise RuntimeError("CUDA error: all CUDA-capable devices are busy or unavailable")
        return capability_of.get(fault, (9, 0))

    monkeypatch.setattr(torch.cuda, "get_device_capability", capability)
    if fault == "no_triton":
        monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    if fault == "no_compiler":
        monkeypatch.setattr(shutil, "which", lambda name: None)
    assert re.search(said, device.missing())
    assert bool(device.missing()) == bool(said)
    assert backend_of("auto").name == ("cpu" if said else "gpu")
    if said:
        with pytest.raises(SplatError, match=said) as caught:
            device.require()
        assert caught.value.code == "raster-no-gpu"
        assert "--backend cpu" in caught.value.hint


def test_what_a_gpu_made_is_looked_at_without_one(monkeypatch):
    run: Any = SimpleNamespace(recorded_settings=lambda: {"train": TrainSettings(backend="gpu")})
    monkeypatch.setenv("TRITON_INTERPRET", "1")
    assert results.backend_of_run(run) == "gpu"
    monkeypatch.delenv("TRITON_INTERPRET")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert results.backend_of_run(run) == "auto"
    assert results.backend_of_run(None) == "auto"


@pytest.mark.parametrize(("size", "tile"), [((480, 358), 8), ((1280, 800), 16)])
def test_small_pictures_have_small_tiles(size, tile):
    rasteriser = GpuRasteriser(16)
    rasteriser.tile = None
    view = rasteriser.view(camera(*size), SETTINGS)
    assert rasteriser._tile(view) == tile


@pytest.mark.parametrize(
    ("card", "fast"), [((9, 0), True), ((8, 9), False), ("gfx942", True), ("gfx1100", False)]
)
def test_cards_with_few_float64_units_compute_footprints_in_float32(card, fast, monkeypatch):
    monkeypatch.delenv("TRITON_INTERPRET", raising=False)
    amd = isinstance(card, str)
    monkeypatch.setattr(torch.version, "hip", "7.1" if amd else None)
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda: card)
    about = SimpleNamespace(name="Card", total_memory=2**34, gcnArchName=card)
    monkeypatch.setattr(torch.cuda, "get_device_properties", lambda number: about)
    assert device.float64_is_fast() == fast
    assert ("float32 footprints" in device.describe()) == (not fast)


def test_a_small_kernel_tells_whether_kernels_run():
    inner.trial()


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (RuntimeError("Triton Error [CUDA]: an illegal memory access was encountered"), "illegal"),
        (RuntimeError("CUDA error: device-side assert triggered"), "assert"),
        (OutOfResources(300_000, 232_448, "shared memory"), "out of resource: shared memory"),
        (subprocess.CalledProcessError(1, ["gcc", "main.c"]), "main.c"),
    ],
)
def test_what_a_device_fails_with_is_told_as_what_it_is(error, said):
    with pytest.raises(SplatError, match=said) as caught, device.gpu_errors_explained(1):
        raise error
    assert caught.value.code == "raster-gpu-failed"


def test_faults_of_the_program_are_not_the_devices():
    for error in (RuntimeError("shapes differ"), InterpreterError("no such name"), KeyError("x")):
        with pytest.raises(type(error)), device.gpu_errors_explained(1):
            raise error


def test_memory_that_runs_out_names_the_cap_that_would_fit():
    with pytest.raises(SplatError) as caught, device.gpu_errors_explained(1_000_000):
        raise torch.OutOfMemoryError("CUDA out of memory")
    assert caught.value.code == "raster-gpu-memory"
    assert "--max-splats 500000" in caught.value.hint
    nearly = device.out_of_memory(1_000_000, free=0, held=4 << 30, total=8 << 30)
    assert nearly.fits == 800_000
    far = device.out_of_memory(10_000_000, free=1 << 30, held=3 << 30, total=8 << 30)
    assert "About 2,273,806 would fit" in far.wanted


def test_a_gpu_that_is_busy_is_named():
    said = "CUDA error: all CUDA-capable devices are busy or unavailable"
    with (
        pytest.raises(SplatError, match="busy or unavailable") as caught,
        device.gpu_errors_explained(1),
    ):
        raise RuntimeError(said)
    assert caught.value.code == "raster-gpu-failed"
    with pytest.raises(RuntimeError, match="shape"), device.gpu_errors_explained(1):
        raise RuntimeError("shape")
