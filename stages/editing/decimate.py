"""Decimation: neighbouring splats are merged, the cheapest pairs first.

Rounds of parallel locally ordered clustering (Meister and Bittner 2018): splats are sorted along a
Morton curve and each is compared with the next few on it; two that are each other's cheapest
partner may be merged. Each round rotates the curve, so that its seams do not accumulate. Time is
linear in the number of splats. SH coefficients, most of a splat's data, are only read when a splat
is merged.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.base import scratch
from stages.base.blocks import blocks, reported_blocks
from stages.editing.moments import Moments, merge, merge_costs
from stages.scene import Splats, logit, morton

# Share of the splats that one round may remove. Small rounds concentrate on the smallest splats,
# which are not visible from afar; large rounds keep more detail that is visible from nearby.
NEAR_ROUND_SHARE, FAR_ROUND_SHARE = 0.2, 0.1
_WINDOW = 16  # splats along the curve that each is compared with
# Factors that break ties: pairs of equal cost would all choose their next neighbour, and hardly two
# would choose each other.
_TIE_BREAK = 1 + 1e-3 * np.random.default_rng(5).random(1 << 12)
_COST_MOST = 3e38
_REMOVAL_GROUP = 4  # of so many neighbours one may be removed in a round: they replace each other
_BLOCK = 1 << 15


@dataclass(frozen=True)
class RemovalCosts:
    """Costs of removing each of N splats, by the views that show them.

    Attributes:
        weights: [N] visible contribution of each splat, in pixels.
        errors: [N] squared error of the pictures if this splat alone is removed; infinite for
            splats that must stay.
    """

    weights: NDArray[np.float64]
    errors: NDArray[np.float64]


RemovalCostsOf = Callable[[Splats], RemovalCosts]


def decimate(
    splats: Splats,
    count: int,
    round_share: float = NEAR_ROUND_SHARE,
    costs_of: RemovalCostsOf | None = None,
) -> Splats:
    """Reduce the splats to at most `count`.

    Args:
        splats: all drawable.
        count: the number of splats to reach, at least 1.
        round_share: the share of the splats that one round may remove.
        costs_of: measures the cost of removing splats. Where it is given, splats are also removed
            without a partner if that is cheaper, and merges are weighted by visibility.
    """
    number, count = 0, max(1, count)
    while len(splats) > count:
        most = max(1, min(len(splats) - count, int(round_share * len(splats))))
        splats = _round(splats, most, number, costs_of)
        number += 1
    return splats


def _round(splats: Splats, most: int, number: int, costs_of: RemovalCostsOf | None) -> Splats:
    """One round, which removes at most `most` splats."""
    # only the order depends on this rotation, so it may be rounded
    axes = np.linalg.qr(np.random.default_rng([11, number]).normal(size=(3, 3)))[0]
    order = morton.morton_order_of(splats.means @ axes.astype(splats.means.dtype))
    removal = costs_of(splats) if costs_of else None
    partners, cost = _partners(splats, order, removal)
    places = np.arange(len(order))
    first = places[(partners[partners] == places) & (places < partners)]
    candidates = np.concatenate([cost[first], _removal_errors(order, removal)])
    cheapest = np.argsort(candidates, kind="stable")[:most]
    cheapest = cheapest[np.isfinite(candidates[cheapest])]
    gone = np.zeros(len(order), bool)
    gone[cheapest[cheapest >= len(first)] - len(first)] = True
    pairs = first[cheapest[cheapest < len(first)]]
    pairs = pairs[~gone[pairs] & ~gone[partners[pairs]]]
    gone[partners[pairs]] = True
    into = np.full(len(order), -1, np.int32)
    into[pairs] = partners[pairs]
    return _with_merged(splats, order, np.flatnonzero(~gone), into)


def _partners(
    splats: Splats, order: NDArray[np.intp], removal: RemovalCosts | None
) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """By position on the curve: (position [N] of the cheapest partner, cost [N] of merging)."""
    count = len(order)
    partners = np.zeros(count, np.int32)
    cheapest = np.full(count, np.inf, np.float32)

    def offer(to: slice, cost: NDArray[np.float64], step: int) -> None:
        better = np.flatnonzero(cost < cheapest[to])
        cheapest[to][better] = cost[better]
        partners[to][better] = to.start + better + step

    for block in reported_blocks(count, _BLOCK):
        rows = order[block.start : block.stop + _WINDOW]
        part = Moments.of(splats, rows)
        weights = part.masses if removal is None else removal.weights[rows]
        for step in range(1, min(_WINDOW, len(rows) - 1) + 1):
            end = min(block.stop, count - step) - block.start
            here, there = slice(0, end), slice(step, end + step)
            cost = merge_costs(part.take(here), part.take(there), weights[here], weights[there])
            cost *= np.resize(np.roll(_TIE_BREAK, 131 * step), len(cost))
            cost = np.fmin(cost, _COST_MOST)
            offer(slice(block.start, block.start + end), cost, step)
            offer(slice(block.start + step, block.start + step + end), cost, -step)
    return partners, cheapest


def _removal_errors(order: NDArray[np.intp], removal: RemovalCosts | None) -> NDArray[np.float64]:
    """By position on the curve: the cost of removing the splat; infinite for all but the cheapest
    of each group of neighbours."""
    if removal is None:
        return np.zeros(0)
    errors = removal.errors[order]
    starts = np.arange(0, len(errors), _REMOVAL_GROUP)
    least = np.repeat(np.minimum.reduceat(errors, starts), _REMOVAL_GROUP)[: len(errors)]
    return np.where(errors <= least, errors, np.inf)


def _with_merged(
    splats: Splats, order: NDArray[np.intp], kept: NDArray[np.intp], into: NDArray[np.int32]
) -> Splats:
    """The splats at the curve positions `kept`. into [N]: the position of the splat that is merged
    into each one, or -1."""
    arrays: dict[str, Any] = {}
    for name in ("means", "quaternions", "log_scales", "opacity_logits", "sh", "sh_degrees"):
        values = getattr(splats, name)
        arrays[name] = scratch.empty((len(kept), *values.shape[1:]), values.dtype)
    for block in blocks(len(kept), _BLOCK):
        places = kept[block]
        part = splats.take(order[places])
        pairs = np.flatnonzero(into[places] >= 0)
        if len(pairs):
            _merge_pairs(part, pairs, splats, order[into[places[pairs]]])
        for name, values in arrays.items():
            values[block] = getattr(part, name)
    return replace(splats, **arrays)


def _merge_pairs(
    part: Splats, pairs: NDArray[np.intp], splats: Splats, rows: NDArray[np.intp]
) -> None:
    """Merge the splats `rows` of `splats` into the splats `pairs` of `part`, in place."""
    found, share = merge(Moments.of(part, pairs), Moments.of(splats, rows))
    part.means[pairs] = found.means
    part.quaternions[pairs], part.log_scales[pairs] = found.shapes()
    part.opacity_logits[pairs] = logit(found.opacities)
    mine = share.astype(part.sh.dtype)[:, None, None]
    part.sh[pairs] = mine * part.sh[pairs] + (1 - mine) * splats.sh[rows]
    part.sh_degrees[pairs] = np.maximum(part.sh_degrees[pairs], splats.sh_degrees[rows])
