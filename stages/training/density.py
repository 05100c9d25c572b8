"""Where the model grows and where it shrinks (adaptive density control, Kerbl et al. 2023)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stages.scene import logit
from stages.scene.rotations import matrices_of
from stages.training.optimiser import Model
from stages.training.strategy import Strategy, photographs_that_see

SPLIT_FACTOR = 1.6  # children of a split are that much smaller
LARGE = 0.01  # of the scene's extent: above it a splat is split, below it cloned
GIANT = 0.1  # of the scene's extent
THRESHOLD = 2e-4  # of the mean gradient, see `AdaptiveDensity`
ENOUGH = 4.0  # photographs: what fewer of them see grows later, and what hangs in the air is such
OPACITY_MIN = 0.005
BYTES_PER_SPLAT = 1600  # parameters, moments, gradients, footprint and about 6 intersections

FEWEST = 10_000  # splats that are always allowed
BASE_MIB = 2048.0  # libraries, and photographs of which at most 1 GiB is kept


def splat_cap(available_mib: float | None) -> int:
    """How many splats may be trained in half of the free memory (of 4 GiB where unknown)."""
    mib = 4096.0 if available_mib is None else available_mib
    return max(FEWEST, int(0.5 * mib * 1024 * 1024 / BYTES_PER_SPLAT))


def needed_mib(splats: int) -> float:
    """Memory of one run that may train as many splats, all its stages, whatever it photographs."""
    return BASE_MIB + splats * BYTES_PER_SPLAT / (1024 * 1024)


def sound(model: Model, settled: bool, extent: float) -> NDArray[np.bool_]:
    """[N] whose values are finite, and once training has settled no giants."""
    keep = np.ones(len(model), bool)
    for array in model.arrays:
        keep &= np.isfinite(array).all(tuple(range(1, array.ndim)))
    if settled:
        keep &= np.exp(model.log_scales.max(1)) <= GIANT * extent
    return keep


@dataclass(frozen=True)
class AdaptiveDensity:
    """Clones small splats and splits large ones where the picture pulls at them hardest, and enough
    photographs see them; see `strategy.Strategy`.

    extent: of the scene, world units. photographs: in training. threshold: of the mean gradient by
    the position on the picture (NDC units of the mean loss).
    """

    extent: float
    photographs: int
    threshold: float = THRESHOLD

    def prune(self, model: Model, settled: bool) -> Model:
        shows = model.opacity_logits >= logit(OPACITY_MIN)
        return model.take(shows & sound(model, settled, self.extent))

    def grow(self, model: Model, budget: int, rng: np.random.Generator) -> Model:
        pull = model.gradient_sum / np.maximum(model.gradient_count, 1)
        wanted = np.flatnonzero(pull >= self.threshold)
        room = max(0, budget - len(model))
        if len(wanted) > room:
            see = photographs_that_see(model.gradient_count[wanted], self.photographs)
            first = np.argsort(-pull[wanted] * np.minimum(1.0, see / ENOUGH), kind="stable")
            wanted = np.sort(wanted[first[:room]])
        large = np.exp(model.log_scales[wanted].max(1)) > LARGE * self.extent
        clones = model.take(wanted[~large]).fresh()
        parents = model.take(wanted[large])
        stay = np.ones(len(model), bool)
        stay[wanted[large]] = False
        grown = model.take(stay).joined(clones).joined(_children(parents, rng))
        grown.forget_gradients()
        return grown


@dataclass(frozen=True)
class Within:
    """Another strategy that grows in a rectangle of the ground plane alone: low and high x and z of
    `bounds` (x0, z0, x1, z1). Outside, where nothing could take its place, no giant is pruned."""

    rule: Strategy
    bounds: tuple[float, ...]

    def prune(self, model: Model, settled: bool) -> Model:
        inside = self._inside(model)
        there = self.rule.prune(model.take(~inside), False)
        return self.rule.prune(model.take(inside), settled).joined(there)

    def grow(self, model: Model, budget: int, rng: np.random.Generator) -> Model:
        inside = self._inside(model)
        there = model.take(~inside)
        there.forget_gradients()
        return self.rule.grow(model.take(inside), budget - len(there), rng).joined(there)

    def _inside(self, model: Model) -> NDArray[np.bool_]:
        at = model.means[:, [0, 2]]
        return np.asarray(((at >= self.bounds[:2]) & (at < self.bounds[2:])).all(1))


def _children(parents: Model, rng: np.random.Generator) -> Model:
    """Two for each parent, drawn from its own Gaussian."""
    twice = parents.take(np.repeat(np.arange(len(parents)), 2)).fresh()
    offsets = rng.normal(size=(len(twice), 3)) * np.exp(twice.log_scales.astype(np.float64))
    twice.means += np.einsum("nij,nj->ni", matrices_of(twice.quaternions), offsets).astype(
        np.float32
    )
    twice.log_scales -= np.float32(np.log(SPLIT_FACTOR))
    return twice
