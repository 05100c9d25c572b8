"""Merging two splats by moment matching: mass, mean, covariance and mean colour are preserved.

The area of a splat is sqrt(ab ab + ac ac + bc bc) for standard deviations a, b, c: up to a factor,
the area that it covers on average over all directions. Its mass is opacity x area. Both follow from
the covariance without its eigenvectors, and are defined for flat splats, too.
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
        return Moments(
            self.means[rows],
            self.covariances[rows],
            self.opacities[rows],
            self.colours[rows],
            self.areas[rows],
        )

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


def merge_costs(
    a: Moments, b: Moments, weight_a: NDArray[np.float64], weight_b: NDArray[np.float64]
) -> NDArray[np.float64]:
    """[N] squared error of merging each pair: Ward's criterion on colours and on shapes.

    weight_a, weight_b [N]: the visibility of each splat: its mass, or its contribution to views.
    """
    _, covariances = _mixed(a, b, a.masses / (a.masses + b.masses))
    grown = np.square(areas_of(covariances) / (a.areas + b.areas))
    differ = np.square(a.colours - b.colours).sum(axis=1)
    together = weight_a * weight_b / (weight_a + weight_b)
    return np.asarray(together * (differ + _SHAPE_WEIGHT * grown))


def _mixed(
    a: Moments, b: Moments, share: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(means, covariances) of the mixture of each pair. share [N]: a's share of the mass."""
    apart = (b.means - a.means).T
    spread = share * (1 - share) * apart[_I] * apart[_J]
    covariances = share * a.covariances.T + (1 - share) * b.covariances.T + spread
    return a.means + ((1 - share) * apart).T, covariances.T
