"""Decimation: neighbouring splats are merged, the cheapest pairs first.

Rounds of parallel locally ordered clustering (Meister and Bittner 2018): splats are sorted along a
Morton curve and each is compared with the next few on it; two that are each other's cheapest
partner may be merged. Each round rotates the curve, so that its seams do not accumulate. Time is
linear in the number of splats. SH coefficients, most of a splat's data, are only read when a splat
is merged.

Merging two splats by moment matching: mass, mean, covariance and mean colour are preserved.

The area of a splat is sqrt(ab ab + ac ac + bc bc) for standard deviations a, b, c: up to a factor,
the area that it covers on average over all directions. Its mass is opacity x area. Both follow from
the covariance without its eigenvectors, and are defined for flat splats, too.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from stages.base.row_slices import row_slices
from stages.formats.values import empty_rows
from stages.raster.definition import ALPHA_MAX
from stages.scene import SH_C0, Splats, logit, morton
from stages.scene.rotations import matrices_of, quaternions_of

# Share of the splats that one round may remove. Small rounds concentrate on the smallest splats,
# which are not visible from afar; large rounds keep more detail that is visible from nearby.
NEAR_ROUND_SHARE, FAR_ROUND_SHARE = 0.2, 0.1
_WINDOW = 16  # splats along the curve that each is compared with
# Factors that break ties: pairs of equal cost would all choose their next neighbour, and hardly two
# would choose each other.
_TIE_BREAK = 1 + 1e-3 * np.random.default_rng(5).random(1 << 12)
_COST_MOST = 3e38
_BLOCK = 1 << 15


def decimate(splats: Splats, count: int, round_share: float = NEAR_ROUND_SHARE) -> Splats:
    """Reduce the splats to at most `count`.

    Args:
        splats: all drawable.
        count: the number of splats to reach, at least 1.
        round_share: the share of the splats that one round may remove.
    """
    number, count = 0, max(1, count)
    while len(splats) > count:
        most = max(1, min(len(splats) - count, int(round_share * len(splats))))
        splats = _round(splats, most, number)
        number += 1
    return splats


def _round(splats: Splats, most: int, number: int) -> Splats:
    """One round, which removes at most `most` splats."""
    # only the order depends on this rotation, so it may be rounded
    axes = np.linalg.qr(np.random.default_rng([11, number]).normal(size=(3, 3)))[0]
    order = morton.morton_order_of(splats.means @ axes.astype(splats.means.dtype))
    partners, cost = _partners(splats, order)
    places = np.arange(len(order))
    first = places[(partners[partners] == places) & (places < partners)]
    pairs = first[np.argsort(cost[first], kind="stable")[:most]]
    gone = np.zeros(len(order), bool)
    gone[partners[pairs]] = True
    into = np.full(len(order), -1, np.int32)
    into[pairs] = partners[pairs]
    return _with_merged(splats, order, np.flatnonzero(~gone), into)


def _partners(
    splats: Splats, order: NDArray[np.intp]
) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """By position on the curve: (position [N] of the cheapest partner, cost [N] of merging)."""
    count = len(order)
    partners = np.zeros(count, np.int32)
    cheapest = np.full(count, np.inf, np.float32)

    def offer(to: slice, cost: NDArray[np.float64], step: int) -> None:
        better = np.flatnonzero(cost < cheapest[to])
        cheapest[to][better] = cost[better]
        partners[to][better] = to.start + better + step

    for block in row_slices(count, _BLOCK):
        rows = order[block.start : block.stop + _WINDOW]
        part = Moments.of(splats, rows)
        for step in range(1, min(_WINDOW, len(rows) - 1) + 1):
            end = min(block.stop, count - step) - block.start
            here, there = slice(0, end), slice(step, end + step)
            cost = merge_costs(part.take(here), part.take(there))
            cost *= np.resize(np.roll(_TIE_BREAK, 131 * step), len(cost))
            cost = np.fmin(cost, _COST_MOST)
            offer(slice(block.start, block.start + end), cost, step)
            offer(slice(block.start + step, block.start + step + end), cost, -step)
    return partners, cheapest


def _with_merged(
    splats: Splats, order: NDArray[np.intp], kept: NDArray[np.intp], into: NDArray[np.int32]
) -> Splats:
    """The splats at the curve positions `kept`. into [N]: the position of the splat that is merged
    into each one, or -1."""
    arrays = empty_rows(splats, len(kept))
    for block in row_slices(len(kept), _BLOCK):
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
    merged, share = merge(Moments.of(part, pairs), Moments.of(splats, rows))
    part.means[pairs] = merged.means
    part.quaternions[pairs], part.log_scales[pairs] = merged.shapes()
    part.opacity_logits[pairs] = logit(merged.opacities)
    mine = share.astype(part.sh.dtype)[:, None, None]
    part.sh[pairs] = mine * part.sh[pairs] + (1 - mine) * splats.sh[rows]
    part.sh_degrees[pairs] = np.maximum(part.sh_degrees[pairs], splats.sh_degrees[rows])


_OPACITY_MIN = 1e-6
_I, _J = np.array([0, 0, 0, 1, 1, 2]), np.array([0, 1, 2, 1, 2, 2])  # of a symmetric matrix
_WHERE = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
_DIAGONAL = [0, 3, 5]
# Weight of the change of shape in the cost of merging, as a squared colour difference: counted once
# if the merged splat covers the area of both, more if it also covers the gap between them. Values
# from 0.05 to 2 hardly change the result.
_SHAPE_WEIGHT = 0.2


@dataclass(frozen=True)
class Moments:
    """Moments of N splats, float64. Two-dimensional arrays are column-major, which saves a fifth of
    the time.

    Attributes:
        means: [N, 3].
        covariances: [N, 6] xx, xy, xz, yy, yz, zz.
        opacities: [N].
        colours: [N, 3] of SH degree 0.
        areas: [N], see above.
    """

    means: NDArray[np.float64]
    covariances: NDArray[np.float64]
    opacities: NDArray[np.float64]
    colours: NDArray[np.float64]
    areas: NDArray[np.float64]

    @classmethod
    def of(cls, splats: Splats, rows: NDArray[np.intp]) -> Moments:
        opacities = 1 / (1 + np.exp(-splats.opacity_logits[rows].astype(np.float64)))
        axes = matrices_of(splats.quaternions[rows])
        axes *= np.exp(splats.log_scales[rows].astype(np.float64))[:, None, :]
        columns = np.ascontiguousarray(axes.transpose(1, 2, 0))
        covariances = (columns[_I] * columns[_J]).sum(axis=1).T
        return cls(
            np.asfortranarray(splats.means[rows], np.float64),
            covariances,
            np.clip(opacities, _OPACITY_MIN, ALPHA_MAX),
            0.5 + SH_C0 * np.asfortranarray(splats.sh[rows, 0], np.float64),
            areas_of(covariances),
        )

    @property
    def masses(self) -> NDArray[np.float64]:
        return self.opacities * self.areas

    def take(self, rows: slice | NDArray[np.intp]) -> Moments:
        return replace(self, **{name: values[rows] for name, values in vars(self).items()})

    def shapes(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(quaternions [N, 4], log_scales [N, 3]) of the covariances."""
        squares, axes = np.linalg.eigh(self.covariances[:, _WHERE])
        axes[:, :, 0] *= np.sign(np.linalg.det(axes))[:, None]
        least = np.maximum(squares[:, 2:] * 1e-14, 1e-60)  # rounding error of a flat splat
        return quaternions_of(axes), 0.5 * np.log(np.maximum(squares, least))


def areas_of(covariances: NDArray[np.float64]) -> NDArray[np.float64]:
    """[N] areas of covariances [N, 6]."""
    xx, xy, xz, yy, yz, zz = covariances.T
    squares = xx * yy - xy * xy + xx * zz - xz * xz + yy * zz - yz * yz
    return np.asarray(np.sqrt(np.maximum(squares, 1e-120)))


def merge(a: Moments, b: Moments) -> tuple[Moments, NDArray[np.float64]]:
    """Merge each splat of `a` with the one of `b` in the same row.

    The mass is reduced by the overlap of the two, which hide each other there. A mass that would
    need an opacity above ALPHA_MAX enlarges the splat instead: from afar it then covers as much as
    both did.

    Returns (the merged splats, a's share of the mass [N]).
    """
    share = a.masses / (a.masses + b.masses)
    means, covariances = _mixed(a, b, share)
    spread = (a.covariances + b.covariances)[:, _DIAGONAL].sum(axis=1) / 3
    apart = np.square(a.means - b.means).sum(axis=1) / np.maximum(spread, 1e-60)
    both = a.opacities * b.opacities * np.minimum(a.areas, b.areas) * np.exp(-0.5 * apart)
    # two equal Gaussians at one place share half of the area of one
    opacities = (a.masses + b.masses - 0.5 * both) / areas_of(covariances)
    over = np.maximum(opacities / ALPHA_MAX, 1.0)
    covariances *= over[:, None]
    part = share[:, None]
    colours = part * a.colours + (1 - part) * b.colours
    opacities = np.clip(opacities / over, _OPACITY_MIN, ALPHA_MAX)
    return Moments(means, covariances, opacities, colours, areas_of(covariances)), share


def merge_costs(a: Moments, b: Moments) -> NDArray[np.float64]:
    """[N] squared error of merging each pair: Ward's criterion on colours and on shapes, weighted
    by mass."""
    mass_a, mass_b = a.masses, b.masses
    _, covariances = _mixed(a, b, mass_a / (mass_a + mass_b))
    grown = np.square(areas_of(covariances) / (a.areas + b.areas))
    differ = np.square(a.colours - b.colours).sum(axis=1)
    together = mass_a * mass_b / (mass_a + mass_b)
    return np.asarray(together * (differ + _SHAPE_WEIGHT * grown))


def _mixed(
    a: Moments, b: Moments, share: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(means, covariances) of the mixture of each pair. share [N]: a's share of the mass."""
    apart = (b.means - a.means).T
    spread = share * (1 - share) * apart[_I] * apart[_J]
    covariances = share * a.covariances.T + (1 - share) * b.covariances.T + spread
    return a.means + ((1 - share) * apart).T, covariances.T
