"""Two splats as one: the same mass of opacity, the same mean, covariance and mean colour.

The area of a splat is sqrt(ab ab + ac ac + bc bc) of its standard deviations a, b, c: up to a
factor what it covers on average over all directions. Its mass is opacity x area. Both follow from
the covariance without its axes, and a flat splat has them too.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stages.raster.definition import ALPHA_MAX
from stages.scene import SH_C0, Splats
from stages.scene.rotations import matrices_of, quaternions_of

_OPACITY_MIN = 1e-6
_I, _J = np.array([0, 0, 0, 1, 1, 2]), np.array([0, 1, 2, 1, 2, 2])  # of a symmetric matrix
_WHERE = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
_DIAGONAL = [0, 3, 5]
# Squared colour that a pair counts besides its own difference, if it covers together what its two
# did; more where the one splat covers what lay between. From 0.05 to 2 it hardly matters.
_SHAPE = 0.2


@dataclass(frozen=True)
class Moments:
    """Of N splats, float64: means [N, 3], covariances [N, 6] (xx, xy, xz, yy, yz, zz),
    opacities [N], colours [N, 3] without what depends on the view, areas [N]. Of two
    axes, each column lies in one piece: a fifth less time for them all."""

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
        return Moments(
            self.means[rows],
            self.covariances[rows],
            self.opacities[rows],
            self.colours[rows],
            self.areas[rows],
        )

    def shapes(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(quaternions [N, 4], log_scales [N, 3])."""
        squares, axes = np.linalg.eigh(self.covariances[:, _WHERE])
        axes[:, :, 0] *= np.sign(np.linalg.det(axes))[:, None]
        least = np.maximum(squares[:, 2:] * 1e-14, 1e-60)  # what rounding leaves of a flat one
        return quaternions_of(axes), 0.5 * np.log(np.maximum(squares, least))


def areas_of(covariances: NDArray[np.float64]) -> NDArray[np.float64]:
    """[N] of covariances [N, 6]."""
    xx, xy, xz, yy, yz, zz = covariances.T
    squares = xx * yy - xy * xy + xx * zz - xz * xz + yy * zz - yz * yz
    return np.asarray(np.sqrt(np.maximum(squares, 1e-120)))


def merge(a: Moments, b: Moments) -> tuple[Moments, NDArray[np.float64]]:
    """(the pairs as one each, a's share of the mass [N]).

    What the two hide of each other is taken off the mass. A mass that would need an opacity above
    what is drawn makes the splat larger instead: seen from afar it covers as much as both did.
    """
    share = a.masses / (a.masses + b.masses)
    means, covariances = _mixed(a, b, share)
    spread = (a.covariances + b.covariances)[:, _DIAGONAL].sum(axis=1) / 3
    apart = np.square(a.means - b.means).sum(axis=1) / np.maximum(spread, 1e-60)
    both = a.opacities * b.opacities * np.minimum(a.areas, b.areas) * np.exp(-0.5 * apart)
    # two equal Gaussians on one place have half of one's area in common
    opacities = (a.masses + b.masses - 0.5 * both) / areas_of(covariances)
    over = np.maximum(opacities / ALPHA_MAX, 1.0)
    covariances *= over[:, None]
    part = share[:, None]
    colours = part * a.colours + (1 - part) * b.colours
    opacities = np.clip(opacities / over, _OPACITY_MIN, ALPHA_MAX)
    return Moments(means, covariances, opacities, colours, areas_of(covariances)), share


def merge_costs(
    a: Moments, b: Moments, weight_a: NDArray[np.float64], weight_b: NDArray[np.float64]
) -> NDArray[np.float64]:
    """[N] squared error that each pair as one brings, weights being what is seen of each (its mass,
    or summed over the pixels of photographs): Ward's criterion on colours, and on shapes."""
    _, covariances = _mixed(a, b, a.masses / (a.masses + b.masses))
    grown = np.square(areas_of(covariances) / (a.areas + b.areas))
    differ = np.square(a.colours - b.colours).sum(axis=1)
    together = weight_a * weight_b / (weight_a + weight_b)
    return np.asarray(together * (differ + _SHAPE * grown))


def _mixed(
    a: Moments, b: Moments, share: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(means, covariances) of both together."""
    apart = (b.means - a.means).T
    spread = share * (1 - share) * apart[_I] * apart[_J]
    covariances = share * a.covariances.T + (1 - share) * b.covariances.T + spread
    return a.means + ((1 - share) * apart).T, covariances.T
