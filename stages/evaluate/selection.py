"""Selects what one round of pruning removes: the splats and SH coefficients that contribute least
per parameter."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from stages.evaluate.contribution import Contributions, near_view_frusta
from stages.evaluate.floaters import near_camera_floaters, splats_in_masks
from stages.raster.sh import own_coefficients
from stages.scene import SH_C0, Camera, Splats, morton, parameters_per_splat

# Predictions for single splats add up only while few are removed at once, and of so many
# neighbours only one: neighbours can replace each other.
ROUND_SHARE, NEIGHBOURS = 0.10, 4
# What fewer views see may fill another view although it hardly shows in these: at the end of a walk
# of 84 views, splats at the border of one or two were worth 2.5 dB in a view from beyond them.
FEW_VIEWS = 3
# A splat at the border of pictures, too, may fill more of another view than of these: pictures are
# continued by this share of their longer side.
BEYOND = 0.1
SH_FACTOR = 2.5  # times as many splats may lose SH degrees: these hardly depend on each other


@dataclass(frozen=True)
class Removal:
    """What one round removes from N splats.

    Args:
        removed: [N] which splats.
        degrees: [N] the SH degree that each splat keeps.
        colour: [N, 3] what is added to its colour for the SH coefficients removed.
        floaters: how many of the removed splats are floaters.
        predicted_sse: predicted change of the views' summed squared error, as if the effects of
            single removals added up.
    """

    removed: NDArray[np.bool_]
    degrees: NDArray[np.uint8]
    colour: NDArray[np.float64]
    floaters: int
    predicted_sse: float

    def apply(self, splats: Splats) -> Splats:
        """The splats that remain, with the SH degrees and colours that they keep."""
        kept = own_coefficients(self.degrees, splats.sh.shape[1])
        sh = np.where(kept, splats.sh, splats.sh.dtype.type(0))
        sh[:, 0] += (self.colour / SH_C0).astype(sh.dtype)
        return replace(splats, sh=sh, sh_degrees=self.degrees).take(~self.removed)


@dataclass(frozen=True)
class RemovalLimits:
    """What one round may remove.

    Args:
        sse_per_parameter: the Lagrange multiplier of the rate-distortion cost.
        most: splats to remove.
        share: of the splats; so many times `SH_FACTOR` may lose SH degrees.
        change: summed squared change of the pictures that removed splats may make, as if the
            effects of single removals added up. Floaters do not count.
        spare: splats that contribute less for each parameter go beyond `change`, too.
        complete: whether contributions to all training views are known. If not, other views may
            need what these hardly see: only splats outside the region around all views are then
            removed at any multiplier.
    """

    sse_per_parameter: float
    most: int
    share: float = ROUND_SHARE
    change: float = np.inf
    spare: float = 0.0
    complete: bool = True


def select_removal(
    splats: Splats, contributions: Contributions, cameras: Sequence[Camera], limits: RemovalLimits
) -> Removal | None:
    """The splats and SH coefficients that contribute less than `limits.sse_per_parameter` for each
    of their parameters, least first; None if there are none.

    A contribution is measured by how much the pictures change. By how much their error changes,
    neighbours that are each a little too much seem harmful one by one, and are missed together: a
    capture lost 5 dB without the tenth that seemed to do most harm. Fine-tuning corrects what the
    residual asks for in any case. The predicted change of the error is measured by the error.

    Floaters, splats outside the region around the views, and those that lie within a picture and
    are hidden in all of them are removed at any multiplier. Other splats that fewer than
    `FEW_VIEWS` views see, or that lie just outside all pictures, are removed last, and only if
    the multiplier is infinite: the views say little about them.

    Args:
        splats: N splats.
        contributions: of them to the views.
        cameras: of all training views, in the same order.
        limits: of the round.
    """
    floaters, free, near = _free(splats, contributions, cameras, limits.complete)
    ratio = contributions.picture_change / parameters_per_splat(splats.sh_degrees)
    ratio[(contributions.view_counts < FEW_VIEWS) & near] = np.finfo(np.float64).max
    ratio[free] = -np.inf
    order = np.argsort(ratio, kind="stable")
    allowed = free | _least_of_neighbours(splats, ratio)
    chosen = order[(allowed & (ratio < limits.sse_per_parameter))[order]][: limits.most]
    changes = np.where(free[chosen], 0.0, contributions.picture_change[chosen])
    chosen = chosen[(np.cumsum(changes) <= limits.change) | (ratio[chosen] < limits.spare)]
    removed = np.zeros(len(splats), bool)
    removed[chosen] = True
    # SH coefficients that contribute more than the last removed splat stay
    reached = 0 < len(chosen) == limits.most
    limit = float(ratio[chosen[-1]]) if reached else limits.sse_per_parameter
    degrees, colour, sh_sse = _select_sh(splats, contributions, removed, limit, limits.share)
    if not len(chosen) and np.array_equal(degrees, splats.sh_degrees):
        return None
    predicted = float(contributions.sse_change[chosen].sum()) + sh_sse
    return Removal(removed, degrees, colour, int(floaters[chosen].sum()), predicted)


def _free(
    splats: Splats, contributions: Contributions, cameras: Sequence[Camera], complete: bool
) -> tuple[NDArray[np.bool_], NDArray[np.bool_], NDArray[np.bool_]]:
    """[N] each: floaters; splats that may go at any multiplier; splats in the region around the
    views. complete: see `RemovalLimits`."""
    seen, near = contributions.view_counts > 0, near_view_frusta(splats, cameras)
    floaters, free = np.zeros(len(splats), bool), ~seen & ~near
    if complete:
        floaters = near_camera_floaters(splats, contributions, cameras)
        floaters |= splats_in_masks(contributions)
        free |= floaters | (~seen & near_view_frusta(splats, cameras, margin=0.0))
    return floaters, free, near


def _least_of_neighbours(splats: Splats, ratio: NDArray[np.float64]) -> NDArray[np.bool_]:
    """[N] the splat with the smallest ratio in each group of neighbours."""
    group = np.empty(len(splats), np.int64)
    group[morton.morton_order(splats)] = np.arange(len(splats)) // NEIGHBOURS
    order = np.lexsort((ratio, group))
    least = np.zeros(len(splats), bool)
    least[order[np.flatnonzero(np.diff(group[order], prepend=-1))]] = True
    return least


def _select_sh(
    splats: Splats,
    contributions: Contributions,
    removed: NDArray[np.bool_],
    sse_per_parameter: float,
    share: float,
) -> tuple[NDArray[np.uint8], NDArray[np.float64], float]:
    """(degrees, colour, predicted change of the error) of the splats that stay; see `Removal`."""
    degrees, colour = splats.sh_degrees.copy(), np.zeros((len(splats), 3))
    best, to = np.full(len(splats), np.inf), np.zeros(len(splats), np.int64)
    change = contributions.truncated_picture_change
    for degree in range(change.shape[1]):
        saved = parameters_per_splat(degrees) - parameters_per_splat(np.full(1, degree))
        ratio = np.where(saved > 0, change[:, degree] / np.maximum(saved, 1), np.inf)
        better = (ratio < best) & ~removed
        best[better], to[better] = ratio[better], degree
    order = np.argsort(best, kind="stable")[: max(1, int(SH_FACTOR * share * len(splats)))]
    rows = order[best[order] < sse_per_parameter]
    degrees[rows] = to[rows]
    if not len(rows):
        return degrees, colour, 0.0
    colour[rows] = contributions.truncated_colour[rows, to[rows]]
    return degrees, colour, float(contributions.truncated_sse_change[rows, to[rows]].sum())
