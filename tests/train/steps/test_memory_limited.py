"""A GPU's memory that is full: fewer splats with "auto", a clean stop with "gpu"."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from stages.base.errors import SplatError
from stages.base.stage import Report
from stages.raster.cpu.rasteriser import CpuRasteriser
from stages.raster.definition import MemoryFull, RasterSettings, splat_arrays
from stages.train import hooks, trainer
from stages.train import stage as train
from stages.train.cap import most_opaque
from stages.train.loss import channel_means
from stages.train.optimiser import LearningRates, new_model
from stages.train.settings import TrainSettings
from stages.train.steps.cpu import CpuStep
from stages.train.steps.memory_limited import MemoryLimitedStep
from stages.train.steps.step import StepInput
from stages.train.views import Level
from tests.scenes import camera, cloud
from tests.small_scene import small_scene

SETTINGS = TrainSettings(steps=60, train_side=48, sh_degree=0, max_splats=400)


class TightStep(CpuStep):
    """On a device that holds `room` splats."""

    room = 150

    def _must_fit(self, splats: int) -> None:
        if splats > self.room:
            raise MemoryFull(splats, max(self.room, splats // 2), "no more of it")

    def load(self, model):
        super().load(model)
        self._must_fit(len(model))

    def step(self, *given):
        self._must_fit(len(self))
        return super().step(*given)


@pytest.fixture
def tight(monkeypatch: pytest.MonkeyPatch) -> type[TightStep]:
    monkeypatch.setattr(trainer, "step_of", lambda backend: TightStep(CpuRasteriser()))
    monkeypatch.setattr(hooks, "CHECKPOINT_SECONDS", 0.0)
    monkeypatch.setattr(TightStep, "room", 150)
    return TightStep


def trained(folder: Path, backend: str):
    """(splats, report, labels of the progress) of a start with 250 splats."""
    (folder / "work").mkdir(exist_ok=True)
    scene, report, labels = small_scene(folder, views=5), Report(), []
    report.listener = lambda label, *rest: labels.append(label)
    inputs = {"sfm": scene.reconstruction, "seed": scene.splats.with_sh_degree(0)}
    settings = TrainSettings(**{**vars(SETTINGS), "backend": backend})
    splats = train.run(inputs, settings, folder / "work", report).splats
    return splats, report, labels


def test_auto_goes_on_with_what_fits_and_says_so(tight, tmp_path: Path) -> None:
    splats, report, labels = trained(tmp_path, "auto")
    assert 0.6 * 150 < len(splats) <= 150  # a third is removed by sparsification
    assert "the GPU's memory is full: going on with 150 splats" in labels
    assert report.metrics["splat_cap"] == 150
    assert report.metrics["splat_cap_from"] == "the GPU's memory"
    assert "train-gpu-memory" in dict(report.warnings)
    assert not (tmp_path / "work" / "cap.json").exists()


def test_a_backend_that_was_asked_for_stops_and_goes_on_from_its_checkpoint(
    tight, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tight.room = 300
    monkeypatch.setattr(hooks.Densification, "after_step", _filled_after_ten)
    with pytest.raises(SplatError) as reported:
        trained(tmp_path, "cpu")
    assert reported.value.code == "raster-gpu-memory"
    assert "at most 130 splats" in reported.value.hint
    assert (tmp_path / "work" / "checkpoint.bin").exists()
    assert json.loads((tmp_path / "work" / "cap.json").read_text())["splats"] == 130
    splats, report, _ = trained(tmp_path, "cpu")
    assert report.metrics["resumed_from_step"] == 11
    assert 0 < len(splats) <= 130
    assert "train-gpu-memory" in dict(report.warnings)


def _filled_after_ten(self: hooks.Densification, trainer: trainer.Trainer, step: int) -> None:
    """Another program takes the rest of the card."""
    if step == 11:
        TightStep.room = 130


def test_what_does_not_fit_at_all_is_still_an_error() -> None:
    model = new_model(*splat_arrays(cloud(1, 20, 20, degree=0)))

    class Nothing(TightStep):
        room = 0

    with pytest.raises(MemoryFull):
        MemoryLimitedStep(Nothing(CpuRasteriser()), lambda fits: None).load(model)


def test_the_splats_that_hide_most_are_kept_in_their_order() -> None:
    model = new_model(*splat_arrays(cloud(9, 20, 20, degree=0)))
    model.opacity_logits[:] = [1, 5, 2, 5, -3, 0, 7, 5, 1]
    np.testing.assert_array_equal(most_opaque(model, 3).opacity_logits, [5, 5, 7])
    assert most_opaque(model, 9) is model


def test_kernels_that_run_out_of_memory_go_on_with_half(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("triton")
    from stages.raster.gpu.rasteriser import GpuRasteriser
    from stages.train.steps.gpu import GpuStep

    rasteriser = GpuRasteriser()
    reported: list[int] = []
    plain = rasteriser.gradients

    def scarce(scene, *rest):
        if len(scene) > 6:
            raise torch.OutOfMemoryError("CUDA out of memory")
        return plain(scene, *rest)

    monkeypatch.setattr(rasteriser, "gradients", scarce)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    made = MemoryLimitedStep(GpuStep(rasteriser), reported.append)
    pixels = np.random.default_rng(0).integers(0, 256, (3, 15, 20)).astype(np.uint8)
    level = Level(camera(20, 15), pixels, channel_means(pixels))
    start = new_model(*(a.copy() for a in splat_arrays(cloud(12, 20, 15, degree=0))))
    made.load(start)
    made.step(
        StepInput(level, RasterSettings(near=0.1, sh_degree=0), LearningRates(), smooth=False)
    )
    assert reported == [6]
    kept = most_opaque(start, 6)
    assert np.abs(made.model().means - kept.means).max() < 1e-2
    assert made.model().steps.max() == 1
