"""The training loop: a view, a picture, a loss, a step; now and then more splats or fewer."""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.base.errors import Interrupted
from stages.base.stage import Report
from stages.measure.images import psnr, ssim
from stages.raster.cpu.rasteriser import NO_SMOOTHING, CpuRasteriser
from stages.raster.definition import RasterSettings
from stages.raster.smoothing import smoothing_widths
from stages.scene import Camera, Splats
from stages.training.checkpoint import load_checkpoint, save_checkpoint
from stages.training.densify import densify, neighbours_together, reset_opacities
from stages.training.loss import image_loss
from stages.training.optimiser import LearningRates, Model, apply_gradients, new_model
from stages.training.schedule import THRESHOLD, Schedule
from stages.training.views import TrainingView

CHECKPOINT_SECONDS = 30.0
SMOOTHING_INTERVAL = 100  # steps after which the filters are measured anew
EVALUATIONS = 10  # during a run, evenly spaced
NEAR = 0.01  # of the scene's extent


@dataclass
class Trainer:
    """One run. cap: splats at most. folder: where checkpoints go. smooth: under the 3D smoothing
    filter."""

    schedule: Schedule
    train: list[TrainingView]
    held_out: list[TrainingView]
    cap: int
    folder: Path
    report: Report
    smooth: bool = False
    use_reference: bool = False

    def __post_init__(self) -> None:
        self.rasteriser = CpuRasteriser()
        self.history: list[dict[str, Any]] = []
        self._v_image = np.empty(0, np.float32)

    def run(self, start: Splats) -> Model:
        """Train from `start`, or go on from the folder's checkpoint; the finished model.

        Raises Interrupted at a step boundary, checkpoint written, when the report asks to stop.
        """
        self.report.progress(0, 1, "compiling kernels")  # a phase of its own, with its own pace
        model, step = self._begin(start)
        last_saved = time.monotonic()
        while step < self.schedule.steps:
            loss = self.step(model, step)
            model = self._adapt(model, step)
            step += 1
            if step % max(1, self.schedule.steps // EVALUATIONS) == 0:
                self._record(model, step)
            if self.schedule.resets_after(step - 1):  # once its pictures have been judged
                reset_opacities(model)
            if self.report.stop_requested.is_set() and step < self.schedule.steps:
                save_checkpoint(self.folder, model, step, self.history)
                raise Interrupted(f"train stopped after step {step} of {self.schedule.steps}")
            if time.monotonic() - last_saved > CHECKPOINT_SECONDS:
                save_checkpoint(self.folder, model, step, self.history)
                last_saved = time.monotonic()
            self._tick(model, step, loss)
            self.report.offer(partial(self.draw, model, step))
        return model

    def _begin(self, start: Splats) -> tuple[Model, int]:
        saved = load_checkpoint(self.folder)
        if saved is not None:
            model, step, self.history = saved
            self.report.metric("resumed_from_step", step)
            return model, step
        start = start.with_sh_degree(self.schedule.sh_degree)
        if len(start) > self.cap:
            start = start.take(np.linspace(0, len(start) - 1, self.cap).round().astype(np.int64))
        start = start.take(neighbours_together(start.means))
        return new_model(
            *(
                np.array(a, np.float32, order="C")
                for a in (
                    start.means,
                    start.quaternions,
                    start.log_scales,
                    start.opacity_logits,
                    start.sh,
                )
            )
        ), 0

    def settings(self, degree: int) -> RasterSettings:
        return RasterSettings(near=NEAR * self.schedule.extent, sh_degree=degree)

    def widths(self, means: NDArray[np.floating]) -> NDArray[np.float32]:
        """[N] of the smoothing filter, from all training photographs at full size."""
        cameras = [view.levels[-1].camera for view in self.train]
        return smoothing_widths(means, cameras, NEAR * self.schedule.extent)

    def _smoothing(self, model: Model) -> NDArray[np.float32]:
        return model.smoothing if self.smooth else NO_SMOOTHING

    def step(self, model: Model, step: int) -> float:
        """One step of Adam on one photograph; the loss before it."""
        if self.smooth and step % SMOOTHING_INTERVAL == 0:
            model.smoothing[:] = self.widths(model.means)
        view = self.train[self.schedule.view(step)]
        level = view.levels[self.schedule.level(step)]
        camera, target = level.camera, level.pixels
        settings = self.settings(self.schedule.active_sh_degree(step))
        if self._v_image.shape != target.shape:
            self._v_image = np.empty(target.shape, np.float32)
        pool, smoothing = self.rasteriser.pool, self._smoothing(model)
        if self.use_reference:
            from stages.training.reference_step import reference_gradients

            backward, value = reference_gradients(
                pool, model.arrays, camera, settings, target, self._v_image, smoothing
            )
        else:
            forward = self.rasteriser.forward(model.arrays, camera, settings, smoothing)
            loss = image_loss(pool, forward.image, target, self._v_image, means=level.means)
            backward = self.rasteriser.backward(model.arrays, forward, self._v_image, smoothing)
            value = loss.value
        factor = self.schedule.rate_factor(step)
        rates = LearningRates().scaled(self.schedule.means_lr(step), factor)
        bands = (settings.sh_degree + 1) ** 2
        apply_gradients(pool, model, backward, bands, rates, camera.width, camera.height)
        return value

    def _adapt(self, model: Model, step: int) -> Model:
        if self.schedule.densifies_after(step):
            model, _ = densify(
                model,
                THRESHOLD,
                self.schedule.extent,
                self.schedule.budget(step, self.cap),
                self.schedule.prunes_giants(step),
                self.schedule.rng(step),
            )
            model = model.take(neighbours_together(model.means))
            if self.smooth:
                model.smoothing[:] = self.widths(model.means)
        return model

    def _tick(self, model: Model, step: int, loss: float) -> None:
        numbers: dict[str, float | int | str] = {"splats": len(model), "loss": round(loss, 4)}
        if self.history and "psnr_db" in self.history[-1]:
            numbers["held_out_psnr_db"] = round(self.history[-1]["psnr_db"], 2)
        self.report.progress(step, self.schedule.steps, "training", **numbers)

    def _record(self, model: Model, step: int) -> None:
        scores = self.evaluate(model)
        entry: dict[str, Any] = {"step": step, "splats": len(model)}
        if scores:
            entry["psnr_db"] = float(np.mean([s["psnr_db"] for s in scores]))
            entry["ssim"] = float(np.mean([s["ssim"] for s in scores]))
        self.history.append(entry)

    def evaluate(self, model: Model) -> list[dict[str, Any]]:
        """PSNR and SSIM of each held-out photograph at full training resolution."""
        scores = []
        for view in self.held_out:
            image, target = self.picture(model, view)
            scores.append(
                {"name": view.name, "psnr_db": psnr(image, target), "ssim": ssim(image, target)}
            )
        return scores

    def picture(
        self, model: Model, view: TrainingView
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """(render, photograph), [H, W, 3], what a viewer would show: clipped to [0, 1]."""
        level = view.levels[-1]
        forward = self.rasteriser.forward(
            model.arrays,
            level.camera,
            self.settings(self.schedule.sh_degree),
            self._smoothing(model),
        )
        image = np.clip(forward.image[:3].transpose(1, 2, 0), 0.0, 1.0)
        return image, level.pixels.transpose(1, 2, 0) * np.float32(1 / 255)

    def draw(self, model: Model, step: int, camera: Camera) -> NDArray[np.uint8]:
        """[H, W, 3] of the model after `step` steps, in the colours that training sees by then."""
        settings = self.settings(self.schedule.active_sh_degree(step - 1))
        forward = self.rasteriser.forward(model.arrays, camera, settings, self._smoothing(model))
        image = np.clip(forward.image[:3].transpose(1, 2, 0), 0.0, 1.0)
        return np.rint(image * 255).astype(np.uint8)
