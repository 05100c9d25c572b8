"""Splats that another program trained, in the run's world and drawn as that program draws them.

A file says neither whether its splats were trained to be drawn with opacity compensation nor, for
most formats, which world they are in. So each reading is drawn at training cameras, and the one
that is nearest to the photographs is taken.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stages import formats
from stages.base.bad_files import reading
from stages.base.errors import SplatError
from stages.base.stage import Report
from stages.base.text import counted
from stages.evaluate.evaluation import (
    EvaluationView,
    load_evaluation_views,
    mean_psnr_db,
)
from stages.evaluate.image_metrics import psnr
from stages.raster.backends import AUTO
from stages.raster.similarity import Similarity
from stages.scene import Reconstruction, Splats, draw_settings_of, evenly_spaced, split_held_out
from stages.seed.settings import check_given

NERFSTUDIO = "dataparser_transforms.json"  # beside the splats: how their world was normalised
_VIEWS, _SIDE = 8, 320  # that readings are compared at; pixels
_HALF_TURN = np.diag([1.0, -1.0, -1.0])  # about x: between y down and y up


@dataclass(frozen=True)
class Reading:
    """One way to read a file.

    Args:
        world: what its coordinates are.
        to_run: from there to the run's world.
        antialias: whether its splats are drawn with opacity compensation.
    """

    world: str
    to_run: Similarity
    antialias: bool

    def __str__(self) -> str:
        return f"{self.world}, {'antialiased' if self.antialias else 'plain'} drawing"

    def of(self, splats: Splats, reconstruction: Reconstruction) -> Splats:
        """The splats of the file in the run's world."""
        linear = self.to_run.scale * self.to_run.rotation
        move = replace(self.to_run, offset=linear @ splats.origin + self.to_run.offset)
        centred = replace(splats, origin=np.zeros(3), place=None, first_camera=None)
        moved = move.apply_to_splats(centred)
        return replace(
            moved,
            means=(moved.means + moved.origin).astype(np.float32),
            origin=reconstruction.origin.copy(),
            draw_settings=replace(draw_settings_of(reconstruction.views), antialias=self.antialias),
        )


def given_splats(path: Path, reconstruction: Reconstruction, report: Report) -> Splats:
    """The splats of `path`, any format that is read.

    Raises SplatError as `check_given` and `formats.read`, and "seed-splats-do-not-fit" where a
    picture of one colour is nearer to the photographs than any reading.
    """
    check_given(path, reconstruction.file_from_world is not None)
    assert reconstruction.file_from_world is not None
    splats, dropped = formats.read_drawable(path)
    if dropped:
        report.warn(
            "seed-splats-dropped",
            f"{counted(dropped, 'splat')} of {path.name} cannot be drawn and are left out.",
        )
    training, _ = split_held_out(reconstruction.views)
    settings = replace(draw_settings_of(reconstruction.views), side=_SIDE)
    views = load_evaluation_views(
        reconstruction.folder, evenly_spaced(training, _VIEWS), settings, report.stop_requested
    )
    found: list[tuple[float, Reading]] = []
    readings = _readings(path, reconstruction.file_from_world)
    for number, one in enumerate(readings):
        report.progress(number, len(readings), f"trying {one}")
        found.append((mean_psnr_db(one.of(splats, reconstruction), views, AUTO), one))
    (best_db, best), (next_db, after), *_ = sorted(found, key=lambda pair: -pair[0])
    report.metric("reading", str(best))
    report.metric("reading_db", round(best_db, 3))
    report.metric("next_reading", str(after))
    report.metric("next_reading_db", round(next_db, 3))
    flat_db = float(np.mean([_flat_db(view) for view in views]))
    if best_db <= flat_db:
        raise _do_not_fit(path, best_db, flat_db, best)
    return best.of(splats, reconstruction)


def _readings(path: Path, file_from_world: NDArray[np.float64]) -> list[Reading]:
    """Every way to read the file, the likeliest first."""
    to_run = _similarity(np.linalg.inv(file_from_world))
    worlds = {
        "the cameras' world": to_run,
        "the cameras' world turned over": to_run.after(Similarity(rotation=_HALF_TURN)),
    }
    if (path.parent / NERFSTUDIO).exists():
        worlds["nerfstudio's normalised world"] = to_run.after(_normalised(path.parent))
    return [
        Reading(world, moved, antialias)
        for world, moved in worlds.items()
        for antialias in (False, True)
    ]


def _normalised(folder: Path) -> Similarity:
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


def _do_not_fit(path: Path, best_db: float, flat_db: float, best: Reading) -> SplatError:
    return SplatError(
        "seed-splats-do-not-fit",
        given=f"{path}, drawn from the cameras of the photographs, has {best_db:.1f} dB at best "
        f"({best}); a picture of one colour has {flat_db:.1f} dB.",
        wanted="Splats of these photographs, in the world of the file that --cameras names.",
        hint="Name the cameras that the splats were trained with. A program that normalises its "
        f"world writes how: nerfstudio's {NERFSTUDIO} is read where it lies beside the splats.",
    )
