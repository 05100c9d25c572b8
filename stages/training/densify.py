"""Where the model grows and where it shrinks (adaptive density control, Kerbl et al. 2023)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stages.raster.definition import OPACITY
from stages.scene import logit
from stages.scene.rotations import matrices_of
from stages.training.optimiser import OPACITY_STEPS, Model

SPLIT_FACTOR = 1.6  # children of a split are that much smaller
LARGE = 0.01  # of the scene's extent: above it a splat is split, below it cloned
GIANT = 0.1  # of the scene's extent
OPACITY_MIN = 0.005
OPACITY_RESET = 0.01
BYTES_PER_SPLAT = 1600  # parameters, moments, gradients, footprint and about 6 intersections


@dataclass(frozen=True)
class Growth:
    """What one densification did. refused: wanted, but over the cap."""

    cloned: int
    split: int
    pruned: int
    refused: int


def splat_cap(available_mib: float | None) -> int:
    """How many splats may be trained in half of the free memory (of 4 GiB where unknown)."""
    mib = 4096.0 if available_mib is None else available_mib
    return max(10_000, int(0.5 * mib * 1024 * 1024 / BYTES_PER_SPLAT))


def densify(
    model: Model,
    threshold: float,
    extent: float,
    cap: int,
    prune_giants: bool,
    rng: np.random.Generator,
) -> tuple[Model, Growth]:
    """Prune what does not show, then clone or split what the photographs pull at hardest.

    threshold: of the mean gradient by the position on the picture (NDC units of the mean loss).
    extent: of the scene, world units. cap: splats at most; the strongest gradients go first.
    """
    keep = _worth_keeping(model, extent, prune_giants)
    pruned = int(len(model) - keep.sum())
    model = model.take(keep)
    pull = model.gradient_sum / np.maximum(model.gradient_count, 1)
    wanted = np.flatnonzero(pull >= threshold)
    room = max(0, cap - len(model))
    refused = max(0, len(wanted) - room)
    if refused:
        strongest = np.argsort(-pull[wanted], kind="stable")[:room]
        wanted = np.sort(wanted[strongest])
    large = np.exp(model.log_scales[wanted].max(1)) > LARGE * extent
    clones = model.take(wanted[~large]).fresh()
    parents = model.take(wanted[large])
    children = _children(parents, rng)
    stay = np.ones(len(model), bool)
    stay[wanted[large]] = False
    grown = model.take(stay).joined(clones).joined(children)
    grown.forget_gradients()
    return grown, Growth(int((~large).sum()), int(large.sum()), pruned, refused)


def _worth_keeping(model: Model, extent: float, prune_giants: bool) -> NDArray[np.bool_]:
    keep = model.opacity_logits >= logit(OPACITY_MIN)
    for array in model.arrays:
        keep &= np.isfinite(array).all(tuple(range(1, array.ndim)))
    if prune_giants:
        keep &= np.exp(model.log_scales.max(1)) <= GIANT * extent
    return np.asarray(keep)


def _children(parents: Model, rng: np.random.Generator) -> Model:
    """Two for each parent, drawn from its own Gaussian."""
    twice = parents.take(np.repeat(np.arange(len(parents)), 2)).fresh()
    offsets = rng.normal(size=(len(twice), 3)) * np.exp(twice.log_scales.astype(np.float64))
    twice.means += np.einsum("nij,nj->ni", matrices_of(twice.quaternions), offsets).astype(
        np.float32
    )
    twice.log_scales -= np.float32(np.log(SPLIT_FACTOR))
    return twice


def reset_opacities(model: Model) -> None:
    """Make everything nearly transparent, so that only what the photographs need comes back; its
    optimisation begins anew."""
    np.minimum(model.opacity_logits, np.float32(logit(OPACITY_RESET)), out=model.opacity_logits)
    model.moment1[:, OPACITY] = 0.0
    model.moment2[:, OPACITY] = 0.0
    model.steps[:, OPACITY_STEPS] = 0
