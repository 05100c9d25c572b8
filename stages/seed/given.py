"""Splats that another program or an earlier run trained, in the run's world and drawn as they were
trained to be.

The file of another program says neither whether its splats were trained to be drawn with opacity
compensation nor, for most formats, which world they are in. So each possible world is drawn at
small pictures of training cameras, and the one that is nearest to the photographs is taken; then
each drawing, at the size of the photographs, because the two differ least where a model was
trained.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from stages import formats
from stages.base.errors import ResourceError, SplatError
from stages.base.memory import MIB, available_mib, training_mib
from stages.base.stage import Report
from stages.base.text import counted, quoted, size
from stages.evaluate.evaluation import EvaluationView, load_evaluation_views, mean_psnr_db
from stages.evaluate.image_metrics import psnr
from stages.raster.backends import AUTO
from stages.scene import Reconstruction, Splats, draw_settings_of, evenly_spaced, split_held_out
from stages.scene.storage import load_splats
from stages.seed.settings import check_given, run_of
from stages.seed.worlds import NERFSTUDIO, World, world_of_run, worlds_of
from stages.sfm.reconstruction_files import load_reconstruction

_SFM = "2-sfm"  # in the folder of a run
_VIEWS, _SMALL = 6, 240  # that worlds are compared at; pixels
_LARGE = 1600  # pixels at most of the drawings: what most programs train at


def given_splats(path: Path, reconstruction: Reconstruction, report: Report) -> Splats:
    """The splats of `path`: a file of any format that is read, or what a stage of a run wrote.

    Raises SplatError as `check_given`, `formats.read` and `world_of_run`, and
    "seed-splats-do-not-fit" where a picture of one colour is nearer to the photographs than any
    reading, and "seed-splats-memory".
    """
    check_given(path, reconstruction.file_from_world is not None)
    splats, worlds, drawings = _readings(path, reconstruction, report)
    small = _views(reconstruction, _SMALL, report)
    by_world = []
    for number, world in enumerate(worlds):
        report.progress(number, len(worlds) + 1, f"trying {world.name}")
        moved = _moved(splats, world, reconstruction)
        by_world.append(max(_db(moved, antialias, small) for antialias in drawings))
    best, *others = np.argsort(by_world)[::-1]
    flat_db = float(np.mean([_flat_db(view) for view in small]))
    if by_world[best] <= flat_db:
        raise _do_not_fit(path, by_world[best], flat_db, worlds[best])
    report.metric("given_world", worlds[best].name)
    report.metric("given_world_db", round(by_world[best], 3))
    if others:
        report.metric("next_world_db", round(by_world[others[0]], 3))
    report.progress(len(worlds), len(worlds) + 1, "trying plain and antialiased drawing")
    found = _moved(splats, worlds[best], reconstruction)
    large = _views(reconstruction, _LARGE, report)
    by_drawing = sorted((_db(found, drawing, large), drawing) for drawing in drawings)[::-1]
    (db, antialias), *next_best = by_drawing
    report.metric("given_drawing", "antialiased" if antialias else "plain")
    report.metric("given_drawing_db", round(db, 3))
    if next_best:
        report.metric("other_drawing_db", round(next_best[0][0], 3))
    return _drawn(found, antialias)


def _readings(
    path: Path, reconstruction: Reconstruction, report: Report
) -> tuple[Splats, list[World], tuple[bool, ...]]:
    """(the splats, the worlds that they may be in, whether they may be antialiased)."""
    _, held_out = split_held_out(reconstruction.views)
    run = run_of(path)
    if run is None:
        splats, dropped = formats.read_drawable(path)
        if dropped:
            report.warn(
                "seed-splats-dropped",
                f"{counted(dropped, 'splat')} of {path.name} cannot be drawn and are left out.",
            )
        _check_memory(path, len(splats))
        _warn_of_held_out(len(held_out), "may have been", report)
        return splats, worlds_of(path, reconstruction), (False, True)
    splats, earlier = load_splats(path), load_reconstruction(run / _SFM)
    training = {view.name for view in split_held_out(earlier.views)[0]}
    if known := sum(view.name in training for view in held_out):
        _warn_of_held_out(known, "were", report)
    world = world_of_run(earlier, reconstruction)
    return splats, [world], (splats.draw_settings.antialias,)


def _check_memory(path: Path, splats: int) -> None:
    """Raise SplatError "seed-splats-memory" for more splats than this machine can go on with."""
    needed, free = training_mib(splats), available_mib()
    if needed > free:
        raise ResourceError(
            "seed-splats-memory",
            given=f"{path} holds {splats:,} splats: measuring and pruning them takes up to "
            f"{size(needed * MIB)}, and {size(free * MIB)} of memory are free.",
            wanted="Splats that fit into memory.",
            hint="Close other programs, or merge splats first: "
            f"splat edit {quoted(path)} smaller.ply --decimate {int(free / training_mib(1) / 2)}",
        )


def _warn_of_held_out(photographs: int, were: str, report: Report) -> None:
    report.warn(
        "seed-held-out-unknown",
        f"The given splats {were} trained on {counted(photographs, 'photograph')} that this run "
        "holds out: their PSNR is then no measure of other views. Held out is every eighth by "
        "name, as in the papers, or with --split the test photographs of --cameras.",
    )


def _views(reconstruction: Reconstruction, side: int, report: Report) -> Sequence[EvaluationView]:
    """Some training views with their photographs, at most `side` pixels long. Views that masks
    cover whole are left out."""
    training, _ = split_held_out(reconstruction.views)
    settings = replace(draw_settings_of(reconstruction), side=side)
    chosen = evenly_spaced(training, _VIEWS)
    stop = report.stop_requested
    loaded = load_evaluation_views(reconstruction.folder, chosen, settings, stop)
    return [view for view in loaded if view.counts]


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
        draw_settings=draw_settings_of(reconstruction),
    )


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
