"""Rotates and translates a sparse model so that up is -Y and the subject is at the origin."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from stages.sfm.worker.sparse_model import SparseModel, point_errors

_ROLL_TOLERANCE_DEG = 12.0  # by how much hand-held cameras roll
_AGREEING_SHARE = 0.7
_PRIOR_WEIGHT = 0.002  # matters only if the cameras' x axes are nearly parallel
_OPPOSED = 0.5  # length of the mean direction of the tops; less: they point opposite ways
_ITERATIONS = 20


def up_direction(rotations: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """[3] unit up vector of the world in which `rotations` [V, 3, 3] (world to camera) are given.

    People pitch cameras but do not roll them: then every camera's x axis is horizontal, and up is
    the direction most nearly perpendicular to all of them, at any pitch. Photographs that were
    rolled or in portrait format are outliers (iteratively reweighted least squares, Cauchy
    weights). Returns None if the cameras do not agree.

    If all x axes are parallel, up is where the tops of the pictures are; or, where these are
    opposed, against the viewing direction: a survey flight turns round after each strip.
    """
    right, down, forward = rotations[:, 0], rotations[:, 1], rotations[:, 2]
    mean_up = -down.mean(axis=0)
    if np.linalg.norm(mean_up) < _OPPOSED:
        mean_up = -forward.mean(axis=0)
    prior = _PRIOR_WEIGHT * (mean_up @ mean_up * np.eye(3) - np.outer(mean_up, mean_up))
    tolerance = np.sin(np.radians(_ROLL_TOLERANCE_DEG))
    weights = np.ones(len(rotations))
    up = np.zeros(3)
    for _ in range(_ITERATIONS):
        scatter = np.einsum("v,vi,vj->ij", weights / weights.sum(), right, right) + prior
        up = np.linalg.eigh(scatter)[1][:, 0]
        weights = 1.0 / (1.0 + ((right @ up) / (0.5 * tolerance)) ** 2)
    agreeing = np.abs(right @ up) < tolerance
    if agreeing.mean() < _AGREEING_SHARE:
        return None
    # The sign: towards the tops of the pictures, or, if all cameras look straight up or down,
    # against the viewing direction.
    tops = float(np.mean(-down[agreeing] @ up))
    sign = tops if abs(tops) > 0.1 else -float(np.mean(forward[agreeing] @ up))
    return up if sign >= 0 else -up


def subject_centre(model: SparseModel) -> NDArray[np.float64]:
    """[3] median of the well-constrained points: those with at least 3 observations and at most the
    median error, weighted by their number of observations."""
    tracks, errors = model.tracks, point_errors(model)
    good = (tracks >= 3) & (errors <= np.median(errors))
    if good.sum() < 10:
        good = np.isfinite(errors)
    return np.median(np.repeat(model.points[good], tracks[good], axis=0), axis=0)


def level_and_recentre(model: SparseModel) -> tuple[SparseModel, bool]:
    """(the model in the new world, whether it was levelled).

    The new world has the subject's centre at the origin. If levelled, up is -Y, and the horizontal
    viewing direction of the first photograph is +Z. Float64 throughout.
    """
    centre = subject_centre(model)
    rotations = model.world_to_camera[:, :3, :3]
    up = up_direction(rotations)
    turn = np.eye(3) if up is None else levelling_rotation(up, rotations[0, 2], rotations[0, 0])
    moved = model.world_to_camera.copy()
    moved[:, :3, :3] = rotations @ turn.T
    moved[:, :3, 3] += rotations @ centre
    points = (model.points - centre) @ turn.T
    return replace(model, world_to_camera=moved, points=points), up is not None


def levelling_rotation(
    up: NDArray[np.float64], heading: NDArray[np.float64], right: NDArray[np.float64]
) -> NDArray[np.float64]:
    """[3, 3] new from old: -Y is `up`, +Z the horizontal part of `heading`; if `heading` is
    vertical, +Z follows from `right`."""
    down = -up
    ahead = heading - (heading @ down) * down
    if np.linalg.norm(ahead) < 0.1:
        ahead = np.cross(right, down)
    ahead = ahead / np.linalg.norm(ahead)
    return np.stack([np.cross(down, ahead), down, ahead])
