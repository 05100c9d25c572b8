"""Splats that another program trained, in the run's world and drawn as that program draws them.

A file says neither whether its splats were trained to be drawn with opacity compensation nor, for
most formats, which world they are in. So each possible world is drawn at small pictures of training
cameras, and the one that is nearest to the photographs is taken; then each drawing, at the size of
the photographs, because the two differ least where a model was trained.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stages import formats
from stages.base.bad_files import reading
from stages.base.errors import SplatError
from stages.base.stage import Report
from stages.base.text import counted
from stages.evaluate.evaluation import EvaluationView, load_evaluation_views, mean_psnr_db
from stages.evaluate.image_metrics import psnr
from stages.raster.backends import AUTO
from stages.raster.similarity import Similarity, rotation_to_up
from stages.scene import Reconstruction, Splats, draw_settings_of, evenly_spaced, split_held_out
from stages.seed.settings import check_given

NERFSTUDIO = "dataparser_transforms.json"  # beside the splats: how their world was normalised
_VIEWS, _SMALL = 6, 240  # that worlds are compared at; pixels
_LARGE = 1600  # pixels at most of the drawings: what most programs train at
_FEWEST_POINTS = 4  # that have principal axes
_FLIPS = tuple(np.diag(signs) for signs in ((1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)))


@dataclass(frozen=True)
class World:
    """A world that the splats of a file may be in, and the way from there to the run's."""

    name: str
    to_run: Similarity


def given_splats(path: Path, reconstruction: Reconstruction, report: Report) -> Splats:
    """The splats of `path`, any format that is read.

    Raises SplatError as `check_given` and `formats.read`, and "seed-splats-do-not-fit" where a
    picture of one colour is nearer to the photographs than any reading.
    """
    check_given(path, reconstruction.file_from_world is not None)
    splats, dropped = formats.read_drawable(path)
    if dropped:
        report.warn(
            "seed-splats-dropped",
            f"{counted(dropped, 'splat')} of {path.name} cannot be drawn and are left out.",
        )
    small, large = (_views(reconstruction, side, report) for side in (_SMALL, _LARGE))
    worlds = _worlds(path, reconstruction)
    by_world = []
    for number, world in enumerate(worlds):
        report.progress(number, len(worlds) + 1, f"trying {world.name}")
        moved = _moved(splats, world, reconstruction)
        by_world.append(max(_db(moved, antialias, small) for antialias in (False, True)))
    first, second, *_ = np.argsort(by_world)[::-1]
    flat_db = float(np.mean([_flat_db(view) for view in small]))
    if by_world[first] <= flat_db:
        raise _do_not_fit(path, by_world[first], flat_db, worlds[first])
    report.progress(len(worlds), len(worlds) + 1, "trying plain and antialiased drawing")
    found = _moved(splats, worlds[first], reconstruction)
    drawn = {antialias: _db(found, antialias, large) for antialias in (False, True)}
    antialias = drawn[True] > drawn[False]
    report.metric("given_world", worlds[first].name)
    report.metric("given_world_db", round(by_world[first], 3))
    report.metric("next_world_db", round(by_world[second], 3))
    report.metric("given_drawing", "antialiased" if antialias else "plain")
    report.metric("given_drawing_db", round(drawn[antialias], 3))
    report.metric("other_drawing_db", round(drawn[not antialias], 3))
    return _drawn(found, antialias)


def _views(reconstruction: Reconstruction, side: int, report: Report) -> Sequence[EvaluationView]:
    """Some training views with their photographs, at most `side` pixels long."""
    training, _ = split_held_out(reconstruction.views)
    settings = replace(draw_settings_of(reconstruction.views), side=side)
    chosen = evenly_spaced(training, _VIEWS)
    return load_evaluation_views(reconstruction.folder, chosen, settings, report.stop_requested)


def _db(splats: Splats, antialias: bool, views: Sequence[EvaluationView]) -> float:
    return mean_psnr_db(_drawn(splats, antialias), views, AUTO)


def _drawn(splats: Splats, antialias: bool) -> Splats:
    return replace(splats, draw_settings=replace(splats.draw_settings, antialias=antialias))


def _moved(splats: Splats, world: World, reconstruction: Reconstruction) -> Splats:
    """The splats of the file in the run's world."""
    linear = world.to_run.scale * world.to_run.rotation
    move = replace(world.to_run, offset=linear @ splats.origin + world.to_run.offset)
    centred = replace(splats, origin=np.zeros(3), place=None, first_camera=None)
    moved = move.apply_to_splats(centred)
    return replace(
        moved,
        means=(moved.means + moved.origin).astype(np.float32),
        origin=reconstruction.origin.copy(),
        draw_settings=draw_settings_of(reconstruction.views),
    )


def _worlds(path: Path, reconstruction: Reconstruction) -> list[World]:
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


def _flat_db(view: EvaluationView) -> float:
    """PSNR of the best picture of one colour."""
    valid = np.ones(view.image.shape[:2], bool) if view.valid is None else view.valid
    flat = np.broadcast_to(view.image[valid].mean(0), view.image.shape)
    return psnr(flat, view.image, valid)


def _do_not_fit(path: Path, best_db: float, flat_db: float, best: World) -> SplatError:
    return SplatError(
        "seed-splats-do-not-fit",
        given=f"{path}, drawn from the cameras of the photographs, has {best_db:.1f} dB at best "
        f"({best.name}); a picture of one colour has {flat_db:.1f} dB.",
        wanted="Splats of these photographs, in the world of the file that --cameras names.",
        hint="Name the cameras that the splats were trained with. Beside splats in nerfstudio's "
        f"normalised world its {NERFSTUDIO} is needed.",
    )
