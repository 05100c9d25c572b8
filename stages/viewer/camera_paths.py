"""Paths through given cameras: their order, interpolation, smoothing and levelling.

The world is y down. All cameras of a path have the same intrinsics.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline

from stages.scene import Camera, Splats, evenly_spaced
from stages.scene.rotations import matrices_of, quaternions_of
from stages.viewer.orbit import common_lens, focus

_STEEPEST_DEG = 80.0  # slope beyond which a camera is not levelled
_SAMPLES = 64  # of each segment between two cameras, to measure its length
_COINCIDENT = 1e-6  # of a path's length: two cameras at one position
_STARTS = 200  # cameras that a tour is tried from, evenly spaced
_DETOUR = 1.5  # times the found tour: a longer given order was not the photographer's way


def tour(cameras: Sequence[Camera], splats: Splats) -> NDArray[np.int64]:
    """[V] an order of the cameras with short steps: the given one, unless it is `_DETOUR` times as
    long as the shortest tour of the nearest-neighbour heuristic."""
    keys = _keys(cameras)
    apart = _lengths(keys[:, None], keys[None], _subject_distance(cameras, splats))
    given = np.arange(len(keys))
    tours = [_nearest_neighbour(apart, start) for start in evenly_spaced(range(len(keys)), _STARTS)]
    shortest = min(tours, key=lambda order: _path_length(order, apart))
    return (
        given if _path_length(given, apart) <= _DETOUR * _path_length(shortest, apart) else shortest
    )


def interpolated(cameras: Sequence[Camera], splats: Splats, frames: int) -> tuple[Camera, ...]:
    """From the first camera to the last at constant speed, through all others.

    Positions and quaternions follow one centripetal Catmull-Rom spline (Yuksel, Schaefer & Keyser,
    "Parameterization and applications of Catmull-Rom curves", 2011), which neither overshoots nor
    loops where cameras are unevenly spaced. Speed includes rotation, by the motion of the subject.
    """
    keys = _keys(cameras)
    _align_signs(keys)
    reach = _subject_distance(cameras, splats)
    steps = _lengths(keys[:-1], keys[1:], reach)
    moved = np.concatenate([[True], steps > _COINCIDENT * max(steps.sum(), 1e-12)])
    keys = keys[moved]
    lens = common_lens(cameras)
    if len(keys) == 1:
        return (_posed(lens, keys[0]),) * frames
    curve = _spline(keys, np.sqrt(_lengths(keys[:-1], keys[1:], reach)))
    travelled = np.concatenate([[0.0], np.cumsum(_lengths(curve[:-1], curve[1:], reach))])
    wanted = np.linspace(0.0, travelled[-1], frames)
    rows = [np.interp(wanted, travelled, column) for column in curve.T]
    return tuple(_posed(lens, row) for row in np.stack(rows, axis=1))


def smoothed_path(cameras: Sequence[Camera], frames: float) -> tuple[Camera, ...]:
    """A smoothed hand-held path: positions and quaternions averaged with Gaussian weights whose
    standard deviation is `frames`. The ends stay near their positions."""
    keys = _keys(cameras)
    _align_signs(keys)
    reach = min(int(np.ceil(3 * frames)), len(keys) - 1)
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / frames) ** 2)
    # Point reflection at the ends keeps them in place.
    padded = np.pad(keys, ((reach, reach), (0, 0)), "reflect", reflect_type="odd")
    rows = [np.convolve(column, weights / weights.sum(), "valid") for column in padded.T]
    steady = zip(cameras, np.stack(rows, axis=1), strict=True)
    return tuple(_posed(camera, pose) for camera, pose in steady)


def levelled(camera: Camera) -> Camera:
    """The camera rotated about its axis until the horizon is level: fully up to a slope of 70
    degrees, and gradually less up to 80."""
    right, down, forward = camera.world_to_camera[:3, :3]
    slope = np.degrees(np.arcsin(min(1.0, abs(forward[1]))))
    share = np.clip((_STEEPEST_DEG - slope) / 10.0, 0.0, 1.0)
    roll = -share * np.arctan2(right[1], down[1])
    turn = np.eye(4)
    turn[:2, :2] = [[np.cos(roll), np.sin(roll)], [-np.sin(roll), np.cos(roll)]]
    return replace(camera, world_to_camera=turn @ camera.world_to_camera)


def length_in_turns(cameras: Sequence[Camera], splats: Splats) -> float:
    """The length of the path from the first camera to the last, in orbits around its subject."""
    keys = _keys(cameras)
    reach = _subject_distance(cameras, splats)
    return float(_lengths(keys[:-1], keys[1:], reach).sum() / (2 * np.pi * max(reach, 1e-12)))


def _subject_distance(cameras: Sequence[Camera], splats: Splats) -> float:
    """The median distance from the cameras to their subject."""
    middle = focus(cameras, splats)
    return float(np.median([np.linalg.norm(camera.centre - middle) for camera in cameras]))


def _keys(cameras: Sequence[Camera]) -> NDArray[np.float64]:
    """[V, 7] positions and quaternions."""
    rotations = np.array([camera.world_to_camera[:3, :3] for camera in cameras])
    return np.hstack([[camera.centre for camera in cameras], quaternions_of(rotations)])


def _align_signs(keys: NDArray[np.float64]) -> None:
    """Choose the sign of each quaternion (q and -q are the same rotation) nearest to the previous
    one."""
    for before, key in itertools.pairwise(keys):
        key[3:] *= np.sign(before[3:] @ key[3:]) or 1.0


def _lengths(a: NDArray[np.float64], b: NDArray[np.float64], reach: float) -> NDArray[np.float64]:
    """[...] the distance between poses [..., 7] (position, quaternion): the translation and, at
    distance `reach`, the displacement by rotation; world units."""
    cosines = np.abs(np.sum(a[..., 3:] * b[..., 3:], axis=-1))
    turns = 2 * np.arccos(np.clip(cosines, 0.0, 1.0))
    return np.asarray(np.hypot(np.linalg.norm(a[..., :3] - b[..., :3], axis=-1), reach * turns))


def _spline(keys: NDArray[np.float64], spans: NDArray[np.float64]) -> NDArray[np.float64]:
    """[M, 7] dense samples of the Catmull-Rom spline through keys [K, 7] with knots `spans` [K - 1]
    apart, quaternions of length 1."""
    ends = np.concatenate([[0.0], np.cumsum(spans)])
    tangents = np.gradient(keys, ends, axis=0)  # for uneven knots those of Catmull and Rom
    shares = np.linspace(0.0, 1.0, _SAMPLES, endpoint=False)
    at = np.append((ends[:-1, None] + spans[:, None] * shares).ravel(), ends[-1])
    curve: NDArray[np.float64] = CubicHermiteSpline(ends, keys, tangents)(at)
    curve[:, 3:] /= np.linalg.norm(curve[:, 3:], axis=1, keepdims=True)
    return curve


def _posed(lens: Camera, pose: NDArray[np.float64]) -> Camera:
    matrix = np.eye(4)
    matrix[:3, :3] = matrices_of(pose[3:])
    matrix[:3, 3] = -matrix[:3, :3] @ pose[:3]
    return replace(lens, world_to_camera=matrix)


def _path_length(order: NDArray[np.int64], apart: NDArray[np.float64]) -> float:
    return float(apart[order[:-1], order[1:]].sum())


def _nearest_neighbour(apart: NDArray[np.float64], start: int) -> NDArray[np.int64]:
    """From the camera `start` each time to the nearest that is left."""
    order, left = [start], np.ones(len(apart), bool)
    left[start] = False
    while left.any():
        order.append(int(np.argmin(np.where(left, apart[order[-1]], np.inf))))
        left[order[-1]] = False
    return np.array(order)
