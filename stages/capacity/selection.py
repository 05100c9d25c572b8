"""What one round takes away: the splats and bands of colour that are worth least for their size."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from stages.measure.contribution import Contributions, near_view_frusta
from stages.measure.floaters import near_camera_floaters
from stages.scene import SH_C0, Camera, Splats, morton, parameters_per_splat

SPLATS_A_ROUND = 0.10  # predictions for single splats add up only while few go at once,
NEIGHBOURS = 4  # and of so many side by side only one: they stand in for each other
BANDS = 2.5  # times as many splats may lose bands: colours hardly depend on each other


@dataclass(frozen=True)
class Removal:
    """gone [N]: which splats. degrees [N], colour [N, 3]: of each the degree that is left, and what
    is added to its colour for the bands that go. floaters: how many of `gone`. predicted_sse: what
    it should change the photographs' squared error by, as if each went alone."""

    gone: NDArray[np.bool_]
    degrees: NDArray[np.uint8]
    colour: NDArray[np.float64]
    floaters: int
    predicted_sse: float

    def of(self, splats: Splats) -> Splats:
        """What is left of them."""
        bands = np.floor(np.sqrt(np.arange(splats.sh.shape[1])))
        kept = (bands <= self.degrees[:, None])[:, :, None]
        sh = np.where(kept, splats.sh, splats.sh.dtype.type(0))
        sh[:, 0] += (self.colour / SH_C0).astype(sh.dtype)
        return replace(splats, sh=sh, sh_degrees=self.degrees).take(~self.gone)


def choose(
    splats: Splats,
    worth: Contributions,
    cameras: Sequence[Camera],
    sse_per_parameter: float,
    most: int,
    share: float = SPLATS_A_ROUND,
    harm: bool = False,
) -> Removal | None:
    """At most `most` splats, and bands of a share of the others, that are worth less squared error
    than `sse_a_number` for each of their numbers; the least worth first. None if there is nothing.

    Worth is by how much the picture changes; harm: by how much the error does. By the error,
    neighbours that are each a little too much seem to harm one by one, and are missed together (a
    carpet fell by 5 dB without the tenth that seemed to harm most), and what learns on after a cut
    mends what the residual asks for in any case. How much the error will change is foretold by it.

    Floaters and what lies where no photograph looks go whatever the price. What continues a picture
    beyond its rim, where none speaks against it, goes last, and only at an infinite price.
    """
    seen, beside = worth.view_counts > 0, near_view_frusta(splats, list(cameras))
    floating = near_camera_floaters(splats, worth, list(cameras))
    free = floating | (~seen & ~beside)
    alone = worth.sse_change if harm else worth.picture_change
    ratio = alone / parameters_per_splat(splats.sh_degrees)
    ratio[~seen & beside] = np.finfo(np.float64).max
    ratio[free] = -np.inf
    order = np.argsort(ratio, kind="stable")
    allowed = free | _first_of_neighbours(splats, ratio)
    chosen = order[(allowed & (ratio < sse_per_parameter))[order]][:most]
    gone = np.zeros(len(splats), bool)
    gone[chosen] = True
    # bands by the worth of the last splat that goes: what is worth more stays, splat or band
    limit = float(ratio[chosen[-1]]) if 0 < len(chosen) == most else sse_per_parameter
    degrees, colour, bands_sse = _cut_bands(splats, worth, gone, limit, share, harm)
    if not len(chosen) and np.array_equal(degrees, splats.sh_degrees):
        return None
    predicted = float(worth.sse_change[chosen].sum()) + bands_sse
    return Removal(gone, degrees, colour, int(floating[chosen].sum()), predicted)


def _first_of_neighbours(splats: Splats, ratio: NDArray[np.float64]) -> NDArray[np.bool_]:
    """[N] the one of each few neighbours that is worth least."""
    place = np.empty(len(splats), np.int64)
    place[morton.morton_order(splats)] = np.arange(len(splats)) // NEIGHBOURS
    order = np.lexsort((ratio, place))
    first = np.zeros(len(splats), bool)
    first[order[np.flatnonzero(np.diff(place[order], prepend=-1))]] = True
    return first


def _cut_bands(
    splats: Splats,
    worth: Contributions,
    gone: NDArray[np.bool_],
    sse_per_parameter: float,
    share: float,
    harm: bool,
) -> tuple[NDArray[np.uint8], NDArray[np.float64], float]:
    """(degrees, colour, predicted change) of the splats that stay, as in `Cut`."""
    degrees, colour = splats.sh_degrees.copy(), np.zeros((len(splats), 3))
    best, to = np.full(len(splats), np.inf), np.zeros(len(splats), np.int64)
    numbers, change = (
        parameters_per_splat(degrees),
        worth.truncated_sse_change if harm else worth.truncated_picture_change,
    )
    for degree in range(splats.sh_degree):
        saved = numbers - parameters_per_splat(np.full(1, degree))
        ratio = np.where(saved > 0, change[:, degree] / np.maximum(saved, 1), np.inf)
        better = (ratio < best) & ~gone
        best[better], to[better] = ratio[better], degree
    order = np.argsort(best, kind="stable")[: max(1, int(BANDS * share * len(splats)))]
    rows = order[best[order] < sse_per_parameter]
    degrees[rows] = to[rows]
    if not len(rows):
        return degrees, colour, 0.0
    colour[rows] = worth.truncated_colour[rows, to[rows]]
    return degrees, colour, float(worth.truncated_sse_change[rows, to[rows]].sum())
