"""Splats that go on learning after a cut, a little and carefully."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from stages.base.errors import Interrupted
from stages.base.stage import Report
from stages.measure.evaluation import EvaluationView
from stages.raster.backends import rasteriser_of
from stages.raster.definition import NO_SMOOTHING, RasterSettings, splat_arrays
from stages.raster.draw import raster_settings_of
from stages.raster.smoothing import smoothing_widths
from stages.scene import IGNORE, Splats
from stages.training.colour_refit import ColourRefit, needs_colour_refit
from stages.training.dropout import Dropout
from stages.training.loss import channel_means
from stages.training.optimiser import LearningRates, Model, new_model
from stages.training.steps import step_of
from stages.training.views import Level

# Of the rates that the recipe begins with: a round starts at the first and ends at the second.
RATE, RATE_END = 1.2, 0.6
MEANS_LR, MEANS_LR_END = 6e-5, 3e-5  # x scene extent


class FineTuner:
    """Goes on with splats where training left them. extent: of the scene, world units. sits_out:
    whether splats sit steps out here, as they did in training, and colours are settled for the
    whole after it."""

    def __init__(
        self,
        photographs: Sequence[EvaluationView],
        extent: float,
        backend: str,
        report: Report,
        dropout: bool = False,
    ) -> None:
        self.photographs, self.extent, self.report = photographs, extent, report
        self.dropout = dropout
        self.cameras = [photograph.camera for photograph in photographs]
        self._means: dict[int, NDArray[np.float32]] = {}  # steps know a photograph by this object
        self.stepper, self.rasteriser = step_of(backend), rasteriser_of(backend)
        self.steps = 0  # made so far

    def finetune(
        self,
        splats: Splats,
        steps: int,
        seen: NDArray[np.int32],
        still: Collection[str] = (),
    ) -> Splats:
        """After `steps` more. seen [N]: how many photographs show each splat. No splat gets smaller
        than what they show, unless it was; bands above a splat's own degree stay empty. still: what
        does not change to the bit, of the fields of `LearningRates`. Raises Interrupted."""
        if not steps or not len(splats):
            return splats
        model = new_model(*(np.array(a, np.float32, order="C") for a in splats.arrays))
        model.sh_degrees[:], model.gradient_count[:] = splats.sh_degrees, seen
        self.stepper.load(model)
        settings = replace(raster_settings_of(splats), sh_degree=splats.sh_degree)
        for number in range(steps):
            if self.report.stop_requested.is_set():
                raise Interrupted("stopped while fine-tuning")
            share = number / steps
            rates = LearningRates().scaled(
                MEANS_LR * self.extent * (MEANS_LR_END / MEANS_LR) ** share,
                RATE * (RATE_END / RATE) ** share,
            )
            rates = replace(rates, **dict.fromkeys(still, 0.0))
            self.stepper.step(self._level(), settings, rates, False, self._dropout())
        finetune = _with(self._finished(self.stepper.model(), splats), splats, still)
        if needs_colour_refit(self.dropout, len(self.photographs)):
            return self._recoloured(finetune, settings, still)
        return finetune

    def _recoloured(
        self, splats: Splats, settings: RasterSettings, still: Collection[str]
    ) -> Splats:
        """See `training.colours`."""
        if "sh_dc" in still:
            return splats
        model = new_model(*splat_arrays(splats))
        model.sh_degrees[:] = 0 if "sh_rest" in still else splats.sh_degrees
        where = self.rasteriser, settings, lambda: map(_level, self.photographs), NO_SMOOTHING
        return replace(splats, sh=ColourRefit(*where).of(model).sh)

    def _dropout(self) -> Dropout | None:
        if not self.dropout:
            return None
        key = int(np.random.default_rng([8, self.steps]).integers(1 << 32))
        return Dropout(len(self.photographs), key)

    def _level(self) -> Level:
        """Every photograph once in each round, in a new order each round."""
        number, place = divmod(self.steps, len(self.photographs))
        self.steps += 1
        order = np.random.default_rng([7, number]).permutation(len(self.photographs))
        which = int(order[place])
        level = _level(self.photographs[which])
        return replace(level, means=self._means.setdefault(which, level.means))

    def _finished(self, model: Model, before: Splats) -> Splats:
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


def _with(finetune: Splats, before: Splats, still: Collection[str]) -> Splats:
    """`tuned`, with `still` as it was: lengths of quaternions and clamped sizes were looked at."""
    sh = finetune.sh.copy()
    for name, bands in (("sh_dc", slice(0, 1)), ("sh_rest", slice(1, None))):
        if name in still:
            sh[:, bands] = before.sh[:, bands]
    arrays = {name: getattr(before, name) for name in still if not name.startswith("sh_")}
    return replace(finetune, sh=sh, **arrays)


def _level(photograph: EvaluationView) -> Level:
    """In the light and over the background that it is judged in, without what is not judged."""
    planar: NDArray[np.uint8] = np.ascontiguousarray(photograph.pixels.transpose(2, 0, 1))
    kept = photograph.valid
    mask = None if kept is None else kept.astype(np.uint8)
    outside = "" if mask is None else IGNORE
    return Level(photograph.camera, planar, channel_means(planar), mask, outside)
