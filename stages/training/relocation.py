"""Splats that do not show move to where others do: 3D Gaussian splatting as sampling from what the
photographs ask for (Kheradmand et al. 2024, "3D Gaussian Splatting as Markov Chain Monte Carlo").

A splat becomes n copies in one place that together look like it: each has the opacity
1 - (1 - o)^(1 / n), and is narrower, since many faint Gaussians over each other have a flatter top
than one. Nothing is split or cloned by gradients: what is faint jitters until it is of use
somewhere or moves to a splat drawn by opacity.

Pressure and jitter come with each round of growth, not with each step: the model lies wherever a
backend's kernels want it, and a round brings it here anyway.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stages.scene import logit
from stages.scene.rotations import matrices_of
from stages.training.density import OPACITY_MIN, sound
from stages.training.optimiser import Model

MOST_COPIES = 51  # of one splat in a round: beyond it the copies' scale is no sum of small numbers
FADING = 0.025  # of its opacity that a splat loses in a round, unless photographs give it back
STIR = 1.0  # standard deviations of itself that a splat without opacity moves in a round
STIR_SLOPE = 100.0  # how fast that falls with opacity, from OPACITY_MIN on


@dataclass(frozen=True)
class Relocation:
    """See `strategy.Strategy`. extent: of the scene, world units."""

    extent: float

    def prune(self, model: Model, settled: bool) -> Model:
        return model.take(sound(model, settled, self.extent))

    def grow(self, model: Model, budget: int, rng: np.random.Generator) -> Model:
        opacities = _opacities(model)
        shows = opacities >= OPACITY_MIN
        drawn = np.zeros(0, np.int64)
        if shows.any():
            wanted = int((~shows).sum()) + max(0, budget - len(model))
            model, opacities = model.take(shows), opacities[shows]
            drawn = rng.choice(len(model), wanted, p=opacities / opacities.sum())
        grown = _copied(model, opacities, drawn)
        _stir(grown, rng)
        grown.opacity_logits[:] = logit(_opacities(grown) * (1.0 - FADING))
        grown.forget_gradients()
        return grown


def shared(
    opacities: NDArray[np.float64], copies: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(opacity of each, what its scales are multiplied by) where a splat of `opacities` [N] becomes
    `copies` [N] in one place.

    In a row of n of opacity p the light that is stopped at offset x is 1 - (1 - p g(x))^n, with g
    the Gaussian of the splat: its integral over x, term by term of the binomial, is that of g times
    the sum over k from 1 to n of (-1)^(k - 1) C(n, k) p^k / sqrt(k).
    """
    each = 1.0 - (1.0 - opacities) ** (1.0 / copies)
    term, area = np.ones_like(each), np.zeros_like(each)
    for k in range(1, int(copies.max(initial=0)) + 1):
        term *= -each * (copies - k + 1) / k
        area -= term / np.sqrt(k)
    return each, opacities / area


def _copied(model: Model, opacities: NDArray[np.float64], drawn: NDArray[np.int64]) -> Model:
    """One copy more of row i for each i in `drawn`; all of one splat begin anew in Adam."""
    copies = np.minimum(1 + np.bincount(drawn, minlength=len(model)), MOST_COPIES)
    parents = np.flatnonzero(copies > 1)
    each, narrower = shared(opacities[parents], copies[parents])
    begun = model.take(parents).fresh()
    begun.opacity_logits[:] = logit(np.maximum(each, OPACITY_MIN))
    begun.log_scales += np.log(narrower).astype(np.float32)[:, None]
    alone = np.ones(len(model), bool)
    alone[parents] = False
    return model.take(alone).joined(begun.take(np.repeat(np.arange(len(parents)), copies[parents])))


def _stir(model: Model, rng: np.random.Generator) -> None:
    """Move what hardly shows by its own size: it may be of use elsewhere."""
    gate = 1.0 / (1.0 + np.exp(STIR_SLOPE * (_opacities(model) - OPACITY_MIN)))
    moved = np.flatnonzero(gate > 1e-3)
    offsets = rng.normal(size=(len(moved), 3)) * np.exp(model.log_scales[moved].astype(np.float64))
    offsets *= STIR * gate[moved, None]
    turned = np.einsum("nij,nj->ni", matrices_of(model.quaternions[moved]), offsets)
    model.means[moved] += turned.astype(np.float32)


def _opacities(model: Model) -> NDArray[np.float64]:
    opacities: NDArray[np.float64] = 1.0 / (1.0 + np.exp(-model.opacity_logits.astype(np.float64)))
    return opacities
