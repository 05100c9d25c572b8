"""Lens distortion: the camera models of COLMAP, and their inverse.

Coordinates are u = X / Z, v = Y / Z of a pinhole camera. A lens distorts them before focal length
and principal point turn them into pixels. The models are those of
https://colmap.github.io/cameras.html; those of other programs are special cases.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stages.base.bad_files import BadFileError

MAX_ANGLE = 1.5  # radians from the axis; a pinhole camera sees less than pi / 2
_BEHIND = 3.1  # radians from the axis; the direction straight behind is a circle in the picture
_TURNS, _ANGLES = 32, 361  # samples of the angle up to which a lens does not fold
_ITERATIONS = 60
_STEP = 1e-6
_TOLERANCE = 1e-9


@dataclass(frozen=True)
class Lens:
    """A lens model and its parameters.

    Args:
        kind: "perspective", "fisheye" (angle from the axis instead of its tangent), "prism fisheye"
            (the same, tangential terms after the radial ones), "polynomial fisheye" (every power of
            the angle in quarter turns), "fov", "division" or "eucm".
        radial: factors of r^2, r^4, ... in 1 + ...
        denominator: the same in the denominator.
        tangential: p1 and p2 in OpenCV's order.
        prism: factors of r^2 and r^4 that are added to u, then to v.
        parameters: of the last four kinds.
        skew: of the other kinds, the share of v that is added to u at the end.
    """

    kind: str = "perspective"
    radial: tuple[float, ...] = ()
    denominator: tuple[float, ...] = ()
    tangential: tuple[float, float] = (0.0, 0.0)
    prism: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    parameters: tuple[float, ...] = ()
    skew: float = 0.0

    def __post_init__(self) -> None:
        if not np.isfinite(self._terms).all():
            raise BadFileError("a lens has a parameter that is not a number")

    @property
    def _terms(self) -> tuple[float, ...]:
        bent = (*self.radial, *self.denominator, *self.tangential, *self.prism)
        return (*bent, *self.parameters, self.skew)

    @property
    def distorts(self) -> bool:
        """Whether it differs from a pinhole."""
        return self.by_angle or any(self._terms)

    @property
    def by_angle(self) -> bool:
        """Whether it is a fisheye: a function of the angle from the axis, which may be 90 degrees
        and more."""
        return "fisheye" in self.kind

    def distort(self, uv: NDArray[np.float64]) -> NDArray[np.float64]:
        """[..., 2] distorted coordinates of `uv` [..., 2]."""
        if not self.by_angle:
            return self._distorted(uv)
        radius = np.linalg.norm(uv, axis=-1, keepdims=True)
        return self._distorted(uv * _ratio(np.arctan(radius), radius))

    def undistort(self, seen: NDArray[np.float64]) -> NDArray[np.float64]:
        """[N, 2] the inverse of `distort` by Newton's method, in the region around the axis where
        `distort` is injective; NaN outside it, and beyond `MAX_ANGLE`."""
        at, converged = self._solved(seen)
        if self.by_angle:
            with np.errstate(all="ignore"):
                angle = np.linalg.norm(at, axis=1, keepdims=True)
                converged &= angle[:, 0] < MAX_ANGLE
                at = at * _ratio(np.tan(angle), angle)
        return np.where(converged[:, None], at, np.nan)

    def project(self, directions: NDArray[np.float64]) -> NDArray[np.float64]:
        """[..., 2] distorted coordinates of directions [..., 3] of any length, of a fisheye. They
        mean nothing beyond `widest_angle`."""
        across = np.linalg.norm(directions[..., :2], axis=-1, keepdims=True)
        angle = np.arctan2(across, directions[..., 2:])
        return self._distorted(directions[..., :2] * _ratio(angle, across))

    def directions(self, seen: NDArray[np.float64]) -> NDArray[np.float64]:
        """[N, 3] unit directions that a fisheye shows at `seen` [N, 2]: the inverse of `project`.
        NaN as of `undistort`, but up to all around."""
        at, converged = self._solved(seen)
        with np.errstate(all="ignore"):
            angle = np.linalg.norm(at, axis=1, keepdims=True)
            converged &= angle[:, 0] < _BEHIND
            shown = np.hstack([at * _ratio(np.sin(angle), angle), np.cos(angle)])
        return np.where(converged[:, None], shown, np.nan)

    def widest_angle(self) -> float:
        """The angle from the axis, radians, up to which a fisheye is injective: beyond, its radius
        decreases, and the picture would show two directions at one place."""
        angles, turns = np.linspace(0, _BEHIND, _ANGLES), np.linspace(0, 2 * np.pi, _TURNS)
        around = np.stack([np.cos(turns), np.sin(turns)], axis=-1)
        at = angles[:, None, None] * around
        with np.errstate(all="ignore"):
            determinants = np.linalg.det(self._jacobian(at.reshape(-1, 2))).reshape(at.shape[:2])
        good = np.logical_and.accumulate((determinants > 0).all(axis=1))
        return float(angles[max(int(good.sum()) - 1, 0)])

    def _solved(self, seen: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """([N, 2] what `_distorted` takes to `seen`, [N] whether it was found)."""
        at = seen.copy()
        with np.errstate(all="ignore"):
            for _ in range(_ITERATIONS):
                off = self._distorted(at) - seen
                step = np.einsum("nij,nj->ni", _inverse(self._jacobian(at)), off)
                length = np.linalg.norm(step, axis=1, keepdims=True)
                at = at - step * np.minimum(1.0, 0.3 / np.maximum(length, 1e-12))
            converged = np.abs(self._distorted(at) - seen).max(axis=1) < _TOLERANCE
            # A step may jump over a fold: from the axis on, the determinant must stay positive.
            for share in np.linspace(0.0, 1.0, 17):
                converged &= np.linalg.det(self._jacobian(share * at)) > 0
        return at, converged

    def _jacobian(self, at: NDArray[np.float64]) -> NDArray[np.float64]:
        """[N, 2, 2] derivatives of `_distorted`."""
        columns = [
            (self._distorted(at + step) - self._distorted(at - step)) / (2 * _STEP)
            for step in _STEP * np.eye(2)
        ]
        return np.stack(columns, axis=-1)

    def _distorted(self, uv: NDArray[np.float64]) -> NDArray[np.float64]:
        """The distortion, after a fisheye's mapping of angles."""
        r2 = np.sum(uv**2, axis=-1, keepdims=True)
        if self.kind == "fov":
            (omega,) = self.parameters
            r = np.sqrt(r2)
            return uv * _ratio(np.arctan(2 * r * np.tan(omega / 2)) / omega, r)
        if self.kind == "polynomial fisheye":
            quarter = np.sqrt(r2) * (2 / np.pi)
            return self._skewed(
                uv * (1.0 + quarter * np.polynomial.polynomial.polyval(quarter, self.parameters))
            )
        if self.kind == "division":
            (k,) = self.parameters
            with np.errstate(invalid="ignore"):
                return np.asarray(uv * (2.0 / (1.0 + np.sqrt(1.0 - 4.0 * k * r2))))
        if self.kind == "eucm":
            alpha, beta = self.parameters
            return np.asarray(uv / (alpha * np.sqrt(beta * r2 + 1.0) + 1.0 - alpha))
        scaled = uv * (_polynomial(self.radial, r2) / _polynomial(self.denominator, r2))
        moved = scaled + self._shift(scaled if self.kind == "prism fisheye" else uv)
        return self._skewed(moved)

    def _skewed(self, uv: NDArray[np.float64]) -> NDArray[np.float64]:
        return uv + uv[..., 1:] * (self.skew, 0.0) if self.skew else uv

    def _shift(self, uv: NDArray[np.float64]) -> NDArray[np.float64]:
        """The tangential and prism terms."""
        if not any((*self.tangential, *self.prism)):
            return np.zeros_like(uv)
        (p1, p2), (s1, s2, s3, s4) = self.tangential, self.prism
        u, v = uv[..., 0], uv[..., 1]
        r2 = u**2 + v**2
        du = 2 * p1 * u * v + p2 * (r2 + 2 * u**2) + s1 * r2 + s2 * r2**2
        dv = 2 * p2 * u * v + p1 * (r2 + 2 * v**2) + s3 * r2 + s4 * r2**2
        return np.stack([du, dv], axis=-1)


PINHOLE = Lens()


def _polynomial(factors: tuple[float, ...], r2: NDArray[np.float64]) -> NDArray[np.float64]:
    value = np.zeros_like(r2)
    for factor in reversed(factors):
        value = (value + factor) * r2
    return 1.0 + value


def _ratio(over: NDArray[np.float64], below: NDArray[np.float64]) -> NDArray[np.float64]:
    """over / below; 1 on the axis, where it is multiplied by 0."""
    return np.where(below > 0, over, 1.0) / np.where(below > 0, below, 1.0)


def _inverse(matrices: NDArray[np.float64]) -> NDArray[np.float64]:
    """Of [N, 2, 2]; zero where there is none."""
    (a, b), (c, d) = matrices.transpose(1, 2, 0)
    determinant = a * d - b * c
    usable = np.abs(determinant) > 1e-12
    swapped = np.stack([np.stack([d, -b], -1), np.stack([-c, a], -1)], -2)
    return np.where(usable[:, None, None], swapped / determinant[:, None, None], 0.0)
