"""Adaptive density control (Kerbl et al. 2023, section 5.2): splats are split where the mean
gradient by their 2D position is large. Nearly transparent and invalid ones are culled, large ones
are not: what is large in the world may be small in every picture, as the walls of a room are.

A split replaces a splat by two along its longest axis (Deng et al. 2024, "Efficient Density Control
for 3D Gaussian Splatting"), instead of a copy of a small splat and two random samples of a large
one: together the two still look like the splat that they replace, so that training need not repair
what a split breaks.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from stages.scene import logit
from stages.scene.rotations import matrices_of
from stages.train.optimiser import Model

# The children of a split, in terms of their parent: distance of their centres from its centre in
# standard deviations of its longest axis; their scale along this axis and across it; their opacity.
CHILD_OFFSET = 0.6
CHILD_LENGTH, CHILD_WIDTH = 0.7, 0.9
CHILD_OPACITY = 0.7
GRADIENT_THRESHOLD = 2e-4  # of the mean gradient by the 2D position, as published
# In longer runs learning rates are lower, and mean gradients smaller: see `gradient_threshold`.
LONG_RUN = 2400  # steps
# Splats that fewer views see are densified last: floaters are among them.
ENOUGH_VIEWS = 4.0
MIN_OPACITY = 0.005


def gradient_threshold(steps: int) -> float:
    """The threshold of a run of `steps`. It falls as 1 / sqrt(steps) in long ones: otherwise 30,000
    steps grow fewer splats than 7,000, and end with a lower PSNR
    (docs/experiments/densification.md#a-lower-threshold)."""
    return GRADIENT_THRESHOLD * math.sqrt(min(1.0, LONG_RUN / steps))


class DensityRule(Protocol):
    """What densifies: models in, models out."""

    def grow(self, model: Model, budget: int, threshold: float = GRADIENT_THRESHOLD) -> Model:
        """The model with new splats, at most `budget` in all; accumulated gradients are reset.
        threshold: of the mean gradient by the 2D position (NDC units of the mean loss)."""

    def inside(self, model: Model) -> NDArray[np.bool_]:
        """[N] splats in the region that the rule densifies."""


@dataclass(frozen=True)
class AdaptiveDensity:
    """Adaptive density control of the whole scene. views: number of training views."""

    views: int

    def grow(self, model: Model, budget: int, threshold: float = GRADIENT_THRESHOLD) -> Model:
        """The model with splats split, at most `budget` splats in all. Where the budget is short,
        splats with the largest gradients that enough views see come first. The accumulated
        gradients are reset."""
        gradient = model.gradient_sum / np.maximum(model.gradient_count, 1)
        chosen = np.flatnonzero(gradient >= threshold)
        room = max(0, budget - len(model))
        if len(chosen) > room:
            seen_by = estimated_view_counts(model.gradient_count[chosen], self.views)
            priority = gradient[chosen] * np.minimum(1.0, seen_by / ENOUGH_VIEWS)
            first = np.argsort(-priority, kind="stable")
            chosen = np.sort(chosen[first[:room]])
        keep = np.ones(len(model), bool)
        keep[chosen] = False
        grown = model.take(keep).joined(split_along_longest_axis(model.take(chosen)))
        grown.reset_gradients()
        return grown

    def inside(self, model: Model) -> NDArray[np.bool_]:
        """See `DensityRule.inside`: all [N]."""
        return np.ones(len(model), bool)


@dataclass(frozen=True)
class BoundedDensity:
    """Adaptive density control that adds splats only inside a rectangle of the ground plane.

    Args:
        rule: is applied inside.
        bounds: (x0, z0, x1, z1) in world units.
    """

    rule: AdaptiveDensity
    bounds: tuple[float, ...]

    def grow(self, model: Model, budget: int, threshold: float = GRADIENT_THRESHOLD) -> Model:
        """See `AdaptiveDensity.grow`."""
        inside = self.inside(model)
        outer = model.take(~inside)
        outer.reset_gradients()
        grown = self.rule.grow(model.take(inside), budget - len(outer), threshold)
        return grown.joined(outer)

    def inside(self, model: Model) -> NDArray[np.bool_]:
        """[N] splats inside the bounds."""
        ground = model.means[:, [0, 2]]
        return np.asarray(((ground >= self.bounds[:2]) & (ground < self.bounds[2:])).all(1))


def cull(model: Model) -> Model:
    """The model without splats that are nearly transparent or not finite: no step improves them."""
    return model.take((model.opacity_logits >= logit(MIN_OPACITY)) & model.finite())


def estimated_view_counts(counts: NDArray[np.int32], views: int) -> NDArray[np.float64]:
    """[N] in how many of the `views` training views each splat is visible, estimated from `counts`
    [N], the numbers of steps in which it was visible since the counters were reset together. All
    views before the first step."""
    most = int(counts.max(initial=0))
    return np.asarray(views * ((counts + 1.0) / (most + 1.0)))


def split_along_longest_axis(parents: Model) -> Model:
    """Two children for each parent, one on either side of its centre on its longest axis, with a
    new optimiser state."""
    children = parents.take(np.repeat(np.arange(len(parents)), 2)).fresh()
    rows = np.arange(len(children))
    longest = children.log_scales.argmax(1)
    axes = matrices_of(children.quaternions)[rows, :, longest]
    sigma = np.exp(children.log_scales[rows, longest].astype(np.float64))
    side = np.where(rows % 2 == 0, CHILD_OFFSET, -CHILD_OFFSET)
    children.means = children.means + ((side * sigma)[:, None] * axes).astype(np.float32)
    log_scales = children.log_scales + np.float32(np.log(CHILD_WIDTH))
    log_scales[rows, longest] += np.float32(np.log(CHILD_LENGTH / CHILD_WIDTH))
    children.log_scales = log_scales
    children.opacity_logits = _logits_scaled(children.opacity_logits, CHILD_OPACITY)
    return children


def _logits_scaled(logits: NDArray[np.float32], factor: float) -> NDArray[np.float32]:
    """The logits of opacities that are `factor` (below 1) times those of `logits`. From
    1 / opacity = 1 + exp(-logit), which rounds neither near 0 nor near 1."""
    with np.errstate(over="ignore"):
        rest = np.exp(-logits.astype(np.float64))
    return np.asarray(-np.log((1.0 + rest) / factor - 1.0), np.float32)
