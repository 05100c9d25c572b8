"""Fewer splats that look the same: neighbours become one, the least costly first.

Rounds of parallel locally ordered clustering (Meister and Bittner 2018): splats in the order of a
Morton curve, each compared with the next few on it; two that are each other's cheapest partner may
become one. Each round lays the curve another way, so that no seam of it stays. Time is linear, and
the view-dependent colour, most of a splat, is only touched when it is merged.
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

# Of the splats that one round may take away. Small rounds spend themselves on what is smallest,
# which nobody sees from afar; larger ones spare more of what is seen from near.
NEAR_ROUND_SHARE, FAR_ROUND_SHARE = 0.2, 0.1
_NEXT = 16  # splats along the curve that each is compared with
# Pairs that cost the same would all choose the one beside them, and hardly two each other.
_UNLIKE = 1 + 1e-3 * np.random.default_rng(5).random(1 << 12)
_COST_MOST = 3e38
_SIDE_BY_SIDE = 4  # of so many only one may be left out in a round: they stand in for each other
_BLOCK = 1 << 15


@dataclass(frozen=True)
class RemovalCosts:
    """Of N splats, in one unit: weights [N]: what is seen of each. alone [N]: squared error that
    leaving out it alone brings; infinite where it must not be left out."""

    weights: NDArray[np.float64]
    alone: NDArray[np.float64]


RemovalCostsOf = Callable[[Splats], RemovalCosts]


def decimate(
    splats: Splats,
    count: int,
    share: float = NEAR_ROUND_SHARE,
    removal_costs: RemovalCostsOf | None = None,
) -> Splats:
    """At most `count` splats (at least 1), by merging, and by leaving out where somebody appraises
    that and it is cheaper. Every splat must be drawable. share: see `NEAR`."""
    number, count = 0, max(1, count)
    while len(splats) > count:
        most = max(1, min(len(splats) - count, int(share * len(splats))))
        splats = _round(splats, most, number, removal_costs)
        number += 1
    return splats


def _round(splats: Splats, most: int, number: int, removal_costs: RemovalCostsOf | None) -> Splats:
    # nothing but the order depends on these axes: they may be rounded
    axes = np.linalg.qr(np.random.default_rng([11, number]).normal(size=(3, 3)))[0]
    order = morton.morton_order_of(splats.means @ axes.astype(splats.means.dtype))
    worth = removal_costs(splats) if removal_costs else None
    partners, cost = _partners(splats, order, worth)
    places = np.arange(len(order))
    first = places[(partners[partners] == places) & (places < partners)]
    alone = _alone(order, worth)
    every = np.concatenate([cost[first], alone])
    cheapest = np.argsort(every, kind="stable")[:most]
    cheapest = cheapest[np.isfinite(every[cheapest])]
    gone = np.zeros(len(order), bool)
    gone[cheapest[cheapest >= len(first)] - len(first)] = True
    pairs = first[cheapest[cheapest < len(first)]]
    pairs = pairs[~gone[pairs] & ~gone[partners[pairs]]]
    gone[partners[pairs]] = True
    into = np.full(len(order), -1, np.int32)
    into[pairs] = partners[pairs]
    return _with_merged(splats, order, np.flatnonzero(~gone), into)


def _partners(
    splats: Splats, order: NDArray[np.intp], worth: RemovalCosts | None
) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """By place along the curve: (the place [N] of the cheapest partner, what that costs [N])."""
    count = len(order)
    partners = np.zeros(count, np.int32)
    cheapest = np.full(count, np.inf, np.float32)

    def offer(to: slice, cost: NDArray[np.float64], step: int) -> None:
        better = np.flatnonzero(cost < cheapest[to])
        cheapest[to][better] = cost[better]
        partners[to][better] = to.start + better + step

    for block in reported_blocks(count, _BLOCK):
        rows = order[block.start : block.stop + _NEXT]
        part = Moments.of(splats, rows)
        weights = part.masses if worth is None else worth.weights[rows]
        for step in range(1, min(_NEXT, len(rows) - 1) + 1):
            end = min(block.stop, count - step) - block.start
            here, there = slice(0, end), slice(step, end + step)
            cost = merge_costs(part.take(here), part.take(there), weights[here], weights[there])
            cost *= np.resize(np.roll(_UNLIKE, 131 * step), len(cost))
            cost = np.fmin(cost, _COST_MOST)
            offer(slice(block.start, block.start + end), cost, step)
            offer(slice(block.start + step, block.start + step + end), cost, -step)
    return partners, cheapest


def _alone(order: NDArray[np.intp], worth: RemovalCosts | None) -> NDArray[np.float64]:
    """By place along the curve: what leaving it out costs; only the least of neighbours may go."""
    if worth is None:
        return np.zeros(0)
    alone = worth.alone[order]
    starts = np.arange(0, len(alone), _SIDE_BY_SIDE)
    least = np.repeat(np.minimum.reduceat(alone, starts), _SIDE_BY_SIDE)[: len(alone)]
    return np.where(alone <= least, alone, np.inf)


def _with_merged(
    splats: Splats, order: NDArray[np.intp], kept: NDArray[np.intp], into: NDArray[np.int32]
) -> Splats:
    """The splats at the places `kept` along the curve; into [N]: the place of what each of them
    takes up, or -1."""
    arrays: dict[str, Any] = {}
    for name in ("means", "quaternions", "log_scales", "opacity_logits", "sh", "sh_degrees"):
        values = getattr(splats, name)
        arrays[name] = scratch.empty((len(kept), *values.shape[1:]), values.dtype)
    for block in blocks(len(kept), _BLOCK):
        places = kept[block]
        part = splats.take(order[places])
        pairs = np.flatnonzero(into[places] >= 0)
        if len(pairs):
            _take_up(part, pairs, splats, order[into[places[pairs]]])
        for name, values in arrays.items():
            values[block] = getattr(part, name)
    return replace(splats, **arrays)


def _take_up(part: Splats, pairs: NDArray[np.intp], splats: Splats, rows: NDArray[np.intp]) -> None:
    """Splats `pairs` of `part` become one with those in `rows` of `splats`."""
    found, share = merge(Moments.of(part, pairs), Moments.of(splats, rows))
    part.means[pairs] = found.means
    part.quaternions[pairs], part.log_scales[pairs] = found.shapes()
    part.opacity_logits[pairs] = logit(found.opacities)
    mine = share.astype(part.sh.dtype)[:, None, None]
    part.sh[pairs] = mine * part.sh[pairs] + (1 - mine) * splats.sh[rows]
    part.sh_degrees[pairs] = np.maximum(part.sh_degrees[pairs], splats.sh_degrees[rows])
