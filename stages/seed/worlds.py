"""The worlds that given splats may be in, and the way from there to the run's.

The file of another program does not say which one it is: `given` draws the splats in each. That of
an earlier run follows from the photographs that both runs have.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stages.base.bad_files import reading
from stages.base.errors import SplatError
from stages.base.text import counted
from stages.cameras import inria
from stages.raster.similarity import Similarity, rotation_to_up
from stages.scene import Camera, Reconstruction, View
from stages.sfm.known.match_cameras import name_parts

NERFSTUDIO = "dataparser_transforms.json"  # beside the splats: how their world was normalised
_FEWEST_POINTS = 4  # that have principal axes
FEWEST_SHARED = 3  # cameras that a similarity follows from
_REWEIGHTED = 50  # times
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
    worlds += _of_cameras_beside(path, reconstruction, known=to_run)
    worlds.append(World("OpenSplat's centred world", to_run.after(_of_opensplat(reconstruction))))
    if len(reconstruction.points) < _FEWEST_POINTS:
        return worlds
    normalised = _of_gsplat(reconstruction)
    for flip in _FLIPS:  # of the axes of the points only the direction is known, not the sign
        world = to_run.after(normalised).after(Similarity(rotation=flip))
        worlds.append(World("gsplat's normalised world", world))
    return worlds


def _of_cameras_beside(
    path: Path, reconstruction: Reconstruction, known: Similarity
) -> list[World]:
    """The world of a cameras.json beside the splats, or two folders above, where the reference
    trainer writes it; none where it is the `known` one."""
    worlds = []
    for folder in (path.parent, *path.parents[2:3]):
        if file := inria.locate(folder):
            pairs = cameras_of_one_name(inria.read(file).views, reconstruction.views, folders=False)
            if len(pairs) < FEWEST_SHARED:
                continue
            found = similarity_between(pairs)
            if not np.allclose(found.inverse_matrix, known.inverse_matrix, rtol=1e-4, atol=1e-4):
                worlds.append(World(f"the world of {file.name}", found))
    return worlds


def world_of_run(earlier: Reconstruction, reconstruction: Reconstruction) -> World:
    """The world of an earlier run, from the cameras of the photographs that both runs have.

    Raises SplatError "seed-splats-do-not-fit" where fewer than three have the same name in both.
    """
    pairs = cameras_of_one_name(earlier.views, reconstruction.views, folders=True)
    if len(pairs) < FEWEST_SHARED:
        raise SplatError(
            "seed-splats-do-not-fit",
            given=f"The run that trained the splats ({earlier.folder.parent}) and this one have "
            f"{counted(len(pairs), 'photograph')} of the same name with a known camera.",
            wanted=f"At least {FEWEST_SHARED}, to bring the splats into this run's world.",
            hint="Give the photographs of that run, with others added if you like.",
        )
    found = similarity_between(pairs)
    # cameras and means are relative to each run's own origin; `given` moves what includes it
    offset = found.offset - found.scale * found.rotation @ earlier.origin
    return World("the earlier run's world", replace(found, offset=offset))


def cameras_of_one_name(
    there: Sequence[View], here: Sequence[View], folders: bool
) -> list[tuple[Camera, Camera]]:
    """(camera there, camera here) of the photographs of one name, suffixes apart.

    Args:
        there, here: the views of two worlds.
        folders: whether names there keep them; without, names that occur twice do not count.
    """

    def by_name(views: Sequence[View]) -> dict[tuple[str, ...], Camera]:
        keys = [tuple(name_parts(view.name)[: None if folders else 1]) for view in views]
        counts = Counter(keys)
        return {k: v.camera for k, v in zip(keys, views, strict=True) if counts[k] == 1}

    old, new = by_name(there), by_name(here)
    return [(old[key], new[key]) for key in old if key in new]


def similarity_between(pairs: Sequence[tuple[Camera, Camera]]) -> Similarity:
    """The similarity that takes the first cameras nearest the second.

    First the rotation and then scale and offset have the least sum of distances (not of their
    squares), so that a camera that one of them has elsewhere does not count.
    """
    turns = np.array([n.world_to_camera[:3, :3].T @ o.world_to_camera[:3, :3] for o, n in pairs])
    rotation, weights = np.eye(3), np.ones(len(pairs))
    for _ in range(_REWEIGHTED):
        left, _, right = np.linalg.svd(np.einsum("v,vij->ij", weights, turns))
        rotation = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
        weights = _inverse(np.linalg.norm(turns - rotation, axis=(1, 2)))
    old, new = (np.array([pair[k].centre for pair in pairs]) for k in (0, 1))
    old, weights = old @ rotation.T, np.ones(len(pairs))
    for _ in range(_REWEIGHTED):
        middles = [weights @ centres / weights.sum() for centres in (old, new)]
        apart, apart_new = old - middles[0], new - middles[1]
        scale = float((weights @ (apart * apart_new).sum(1)) / (weights @ (apart**2).sum(1)))
        offset = middles[1] - scale * middles[0]
        weights = _inverse(np.linalg.norm(new - scale * old - offset, axis=1))
    return Similarity(scale, rotation, offset)


def _inverse(residuals: NDArray[np.float64]) -> NDArray[np.float64]:
    """Weights by which least squares find the least sum of residuals (Weiszfeld 1937)."""
    return np.asarray(1.0 / np.maximum(residuals, 1e-9 * residuals.max() + 1e-150))


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
