"""The worlds that the splats of another program may be in, and the way from there to the run's.

A file does not say which one it is: `given` draws the splats in each.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stages.base.bad_files import reading
from stages.raster.similarity import Similarity, rotation_to_up
from stages.scene import Reconstruction

NERFSTUDIO = "dataparser_transforms.json"  # beside the splats: how their world was normalised
_FEWEST_POINTS = 4  # that have principal axes
_FLIPS = tuple(np.diag(signs) for signs in ((1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)))


@dataclass(frozen=True)
class World:
    """A world that the splats of a file may be in, and the way from there to the run's."""

    name: str
    to_run: Similarity


def worlds_of(path: Path, reconstruction: Reconstruction) -> list[World]:
    """The likeliest first."""
    assert reconstruction.file_from_world is not None
    to_run = _similarity(np.linalg.inv(reconstruction.file_from_world))
    half_turn = Similarity(rotation=_FLIPS[1])  # between y down and y up
    worlds = [
        World("the cameras' world", to_run),
        World("the cameras' world, turned over", to_run.after(half_turn)),
    ]
    if (path.parent / NERFSTUDIO).exists():
        worlds.append(
            World("nerfstudio's normalised world", to_run.after(_of_nerfstudio(path.parent)))
        )
    worlds.append(World("OpenSplat's centred world", to_run.after(_of_opensplat(reconstruction))))
    if len(reconstruction.points) < _FEWEST_POINTS:
        return worlds
    normalised = _of_gsplat(reconstruction)
    for flip in _FLIPS:  # of the axes of the points only the direction is known, not the sign
        world = to_run.after(normalised).after(Similarity(rotation=flip))
        worlds.append(World("gsplat's normalised world", world))
    return worlds


def _of_opensplat(reconstruction: Reconstruction) -> Similarity:
    """From OpenSplat's world to that of the camera file: there the mean of the cameras is the
    origin, and their largest coordinate 1 (OpenSplat, autoScaleAndCenterPoses)."""
    centres = _file_centres(reconstruction)
    middle = centres.mean(axis=0)
    return Similarity(float(np.abs(centres - middle).max()), offset=middle)


def _file_centres(reconstruction: Reconstruction) -> NDArray[np.float64]:
    """[V, 3] the cameras in the world of their file."""
    to_file = reconstruction.file_from_world
    assert to_file is not None
    centres = np.array([view.camera.centre for view in reconstruction.views])
    return np.asarray(centres @ to_file[:3, :3].T + to_file[:3, 3])


def _of_gsplat(reconstruction: Reconstruction) -> Similarity:
    """From the world that gsplat's example trainer normalises its data to, to that of the camera
    file (as its examples normalise cameras and points).

    There the mean up direction of the cameras is turned to -y, the median of the points on the
    viewing axes that are nearest to the origin becomes the origin, and the median distance of the
    cameras 1. Then the median of the sparse points becomes the origin, and the axes are their
    principal ones.
    """
    to_file = reconstruction.file_from_world
    assert to_file is not None
    file = _similarity(to_file)
    cameras = [file.apply_to_camera(view.camera) for view in reconstruction.views]
    axes = np.array([camera.world_to_camera[:3, :3] for camera in cameras])
    turn = rotation_to_up(-axes[:, 1].mean(axis=0))
    centres = np.array([camera.centre for camera in cameras]) @ turn.T
    ahead = axes[:, 2] @ turn.T
    nearest = centres - (centres * ahead).sum(1)[:, None] * ahead
    middle = np.median(nearest, axis=0)
    scale = 1.0 / float(np.median(np.linalg.norm(centres - middle, axis=1)))
    points = reconstruction.points @ (file.scale * file.rotation).T + file.offset
    points = scale * (points @ turn.T - middle)
    centroid = np.median(points, axis=0)
    principal = np.linalg.eigh(np.cov(points, rowvar=False))[1][:, ::-1].copy()
    principal[:, 0] *= np.sign(np.linalg.det(principal))
    first = Similarity(scale, turn, -scale * middle)
    second = Similarity(1.0, principal.T, -principal.T @ centroid)
    return _similarity(second.after(first).inverse_matrix)


def _of_nerfstudio(folder: Path) -> Similarity:
    """From nerfstudio's normalised world to that of its camera file. nerfstudio maps a point p of
    the file to scale * transform @ (p, 1). Raises SplatError "splats-unreadable"."""
    with reading(folder / NERFSTUDIO):
        data = json.loads((folder / NERFSTUDIO).read_text(encoding="utf-8"))
        to_file = np.eye(4)
        to_file[:3] = np.array(data["transform"], np.float64).reshape(3, 4)
        to_file[:3] *= float(data["scale"])
        return _similarity(np.linalg.inv(to_file))


def _similarity(matrix: NDArray[np.floating]) -> Similarity:
    """Of a matrix [4, 4] whose linear part is a rotation times a scale."""
    linear = matrix[:3, :3].astype(np.float64)
    scale = float(np.cbrt(np.linalg.det(linear)))
    return Similarity(scale, linear / scale, matrix[:3, 3].astype(np.float64))
