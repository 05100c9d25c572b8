"""Continues the training of given splats on given views, with small learning rates.

`prune` fine-tunes after rounds that a target needs, `quantise` fine-tunes to plain drawing and to
what file formats round, and blocks of a large scene are fine-tuned where they meet. The number of
splats never changes.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from stages.base.errors import Interrupted
from stages.base.stage import Report
from stages.evaluate.evaluation import EvaluationView
from stages.raster.backends import rasteriser_of
from stages.raster.definition import RasterSettings
from stages.raster.draw import raster_settings_of
from stages.raster.smoothing import smoothing_widths
from stages.scene import IGNORE, Splats
from stages.train.colour_refit import ColourRefit, needs_colour_refit
from stages.train.conversion import model_of
from stages.train.dropout import Dropout
from stages.train.optimiser import LearningRates, Model, camera_distances
from stages.train.schedule import FULL, HALF, SCALES, SMALLER_STEPS, SMALLER_STEPS_PERIOD
from stages.train.steps.step import StepInput, step_of
from stages.train.views import Level

# Factors of the default learning rates: at the first step of a call, and at its last.
RATES = 1.2, 0.6
MEANS_LR, MEANS_LR_END = 6e-5, 3e-5  # x scene extent
_SH_COLUMNS = {"sh_dc": slice(0, 1), "sh_rest": slice(1, None)}


class FineTuner:
    """Fine-tunes splats on a set of training views.

    Args:
        views: training views; each step uses one, in a new random order each epoch.
        extent: of the scene, in world units; the learning rate of the means scales with it.
        backend: name of the rasteriser.
        report: says before each step whether to stop.
        dropout: whether to use dropout, and to refit colours afterwards, as training did.
        half_size: whether every second step uses its view at half the size. Otherwise steps use
            smaller views as often as training does, and none of the last three of a call does.
        rates: as `RATES`.
    """

    def __init__(
        self,
        views: Sequence[EvaluationView],
        extent: float,
        backend: str,
        report: Report,
        dropout: bool = False,
        half_size: bool = False,
        rates: tuple[float, float] = RATES,
    ) -> None:
        self.views, self.extent, self.report, self.dropout = views, extent, report, dropout
        self.half_size, self.rates, self.cameras = half_size, rates, [view.camera for view in views]
        self.steps = 0  # done in all calls; the order of views and dropout depend on it
        # By view and size: steps tell views apart by these objects.
        self._means: dict[tuple[int, int], NDArray[np.float32]] = {}
        self._stepper, self._rasteriser = step_of(backend), rasteriser_of(backend)

    def finetune(
        self,
        splats: Splats,
        steps: int,
        view_counts: NDArray[np.int32],
        frozen: Collection[str] = (),
        progress: str = "",
    ) -> Splats:
        """The same splats after more steps; SH coefficients above each splat's degree stay zero.

        Args:
            splats: N of them.
            steps: how many; 0 returns `splats`.
            view_counts: [N] in how many views each splat is visible.
            frozen: parameters that keep their exact values, by the names of `LearningRates`.
            progress: what the report says is done, with the number of the step; nothing if empty.

        Raises Interrupted when the report asks to stop.
        """
        if not steps or not len(splats):
            return splats
        model = model_of(splats)
        model.sh_degrees[:], model.gradient_count[:] = splats.sh_degrees, view_counts
        model.distances[:] = camera_distances(model.means, self.cameras, self.extent)
        self._stepper.load(model)
        settings = replace(raster_settings_of(splats), sh_degree=splats.sh_degree)
        for number in range(steps):
            if self.report.stop_requested.is_set():
                raise Interrupted("stopped while fine-tuning")
            if progress:
                self.report.progress(number, steps, progress)
            done = number / steps
            rates = LearningRates().scaled(
                MEANS_LR * self.extent * (MEANS_LR_END / MEANS_LR) ** done,
                self.rates[0] * (self.rates[1] / self.rates[0]) ** done,
                self.extent,
            )
            rates = replace(rates, **dict.fromkeys(frozen, 0.0))
            size, weight = self._size(steps - number)
            level, dropout = self._next_level(size), self._dropout()
            self._stepper.step(StepInput(level, settings, rates, dropout=dropout, weight=weight))
        found = _with_frozen(self._to_splats(self._stepper.model(), splats), splats, frozen)
        if needs_colour_refit(self.dropout, len(self.views)) and "sh_dc" not in frozen:
            found = self._refit_colours(found, settings, "sh_rest" in frozen)
        return found

    def _refit_colours(self, splats: Splats, settings: RasterSettings, only_dc: bool) -> Splats:
        model = model_of(splats)
        model.sh_degrees[:] = 0 if only_dc else splats.sh_degrees
        refit = ColourRefit(self._rasteriser, settings, lambda: map(_level_of, self.views))
        return replace(splats, sh=refit.of(model).sh)

    def _dropout(self) -> Dropout | None:
        if not self.dropout:
            return None
        key = int(np.random.default_rng([8, self.steps]).integers(1 << 32))
        return Dropout(len(self.views), key)

    def _size(self, left: int) -> tuple[int, float]:
        """(index into `SCALES`, factor of the gradients) of the next step, with which `left` steps
        of a call are left."""
        if self.half_size:
            return (HALF if self.steps % 2 else FULL), 1.0
        size = SMALLER_STEPS.get(left % SMALLER_STEPS_PERIOD, FULL)
        return size, SCALES[size] ** -2

    def _next_level(self, size: int) -> Level:
        number = self.steps // 2 if self.half_size else self.steps
        epoch, place = divmod(number, len(self.views))
        self.steps += 1
        row = int(np.random.default_rng([7, epoch]).permutation(len(self.views))[place])
        level = _level_of(self.views[row].scaled(SCALES[size]))
        return replace(level, means=self._means.setdefault((row, size), level.means))

    def _to_splats(self, model: Model, before: Splats) -> Splats:
        """With unit quaternions, all N rows. No splat is finer than its views can show, unless it
        already was."""
        norms = np.linalg.norm(model.quaternions, axis=1, keepdims=True)
        with np.errstate(divide="ignore"):
            finest = np.log(smoothing_widths(before.means, self.cameras, before.draw_settings.near))
        least = np.minimum(before.log_scales, finest[:, None])
        return replace(
            before,
            means=model.means.copy(),
            quaternions=(model.quaternions / norms).astype(np.float32),
            log_scales=np.maximum(model.log_scales, least).astype(np.float32),
            opacity_logits=model.opacity_logits.copy(),
            sh=model.sh.copy(),
        )


def _with_frozen(splats: Splats, before: Splats, frozen: Collection[str]) -> Splats:
    """`splats` with the frozen parameters of `before`: normalising and clamping changed them."""
    sh = splats.sh.copy()
    for name in _SH_COLUMNS.keys() & frozen:
        sh[:, _SH_COLUMNS[name]] = before.sh[:, _SH_COLUMNS[name]]
    arrays = {name: getattr(before, name) for name in frozen if name not in _SH_COLUMNS}
    return replace(splats, sh=sh, **arrays)


def _level_of(view: EvaluationView) -> Level:
    """The view as a training step takes it: its pixels as they are evaluated, masked pixels
    ignored."""
    mask = None if view.valid is None else view.valid.astype(np.uint8)
    return Level.from_pixels(view.camera, view.pixels, mask, IGNORE if mask is not None else "")
