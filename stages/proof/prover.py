"""Proof that a file holds the splats that it was made from.

A parser that did not write it reads it back, the rasteriser draws it from cameras that training
never saw, and every value is compared with the original's. Of very many splats those in the middle
are drawn: drawing takes more memory than they do.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.base.blocks import blocks
from stages.formats import BY_ENDING, format_of
from stages.formats.values import LOG_SCALE_MIN, LOGIT_MAX, LOGIT_MIN, drop_undrawable
from stages.measure.image_metrics import IDENTICAL_DB, capped_psnr_db
from stages.proof import checks, diagnosis
from stages.proof.compare import differences
from stages.proof.content import FileContent
from stages.proof.matching import Rows
from stages.raster.backends import AUTO
from stages.raster.draw import raster_settings_of, renderer
from stages.scene import Camera, Splats, View, evenly_spaced, split_held_out
from stages.scene.framing import orbit_cameras

_SIDE_PX = 480
_CAMERAS = 3
_MIDDLE = 0.5  # of the splats, to look at where no photographs tell: the rest is background
_MOST_DRAWN = 1 << 22
_LOSSLESS_DB = 45.0  # below it a file that should hold everything is wrong
_LOSSY_DB = 30.0  # below it the loss is worth a warning


@dataclass(frozen=True)
class Proof:
    """What was found about one file.

    splats: how many it holds. figures: verify_db (PSNR between pictures of the original and of the
    file, the worst camera), verify_mean_db, verify_cameras, and the largest errors of the values;
    worst_attribute and worst_splat: whose largest error shows most, and its row in the file.
    fault: why the file is wrong, "" if it is not; the figures are empty where nothing could be
    compared. loss_db: what a lossy file lost if that is worth a warning, else None.
    """

    splats: int
    figures: dict[str, Any]
    fault: str = ""
    loss_db: float | None = None


def cameras_for(splats: Splats, views: Sequence[View] = ()) -> tuple[Camera, ...]:
    """Three cameras to compare from: of held-out views spread over the capture, of other views
    where none are held out, around the splats where there are none at all."""
    training, held = split_held_out(tuple(views))
    chosen = held or training
    if not chosen:
        return tuple(camera.fitted(_SIDE_PX) for camera in orbit_cameras(splats, _CAMERAS, _MIDDLE))
    return tuple(view.camera.fitted(_SIDE_PX) for view in evenly_spaced(chosen, _CAMERAS))


@dataclass(frozen=True)
class Prover:
    """Compares files with one original, whose pictures are drawn once.

    splats: the original, as `rows.kept_rows` leaves it. drawn: which of its rows are. came_as: the
    format of the file that it was read from, "" if it was not; after a lossy one nothing can be
    asked of float32.
    """

    splats: Splats
    drawn: NDArray[np.bool_] | slice
    cameras: tuple[Camera, ...]
    pictures: tuple[NDArray[np.float32], ...]
    backend: str
    came_as: str

    @classmethod
    def of(
        cls,
        splats: Splats,
        cameras: tuple[Camera, ...],
        backend: str = AUTO,
        came_as: str = "",
    ) -> Prover:
        drawn = _middle(splats)
        draw = renderer(splats.take(drawn), raster_settings_of(splats), backend)
        pictures = tuple(draw(camera).image for camera in cameras)
        return cls(splats, drawn, cameras, pictures, backend, came_as)

    def prove(self, path: Path, exact: bool = False) -> Proof:
        """Read `path` with a second parser, draw it and compare. Nothing is raised for a file
        that is wrong.

        exact: whether even a format that keeps less than float32 has to give the same, because the
        original was read from the file itself.
        """
        row = format_of(path)
        try:
            content = _drawable(checks.read_back(path))
            errors = checks.CHECKS[row.ending].validate(path)
        except Exception as error:  # whatever another parser raises: the file is wrong
            return Proof(0, {}, f"another reader refused it ({_words(error)})")
        count = len(content.splats)
        if errors:
            return Proof(count, {}, f"its validator says: {errors[0]}")
        if count != len(self.splats):
            return Proof(count, {}, f"it holds {count} of {len(self.splats)} splats")
        names = tuple(filter(None, (row.ending, self.came_as)))
        lossy = not exact and any(BY_ENDING[name].loses for name in names)
        return self._compared(content, names, lossy)

    def _compared(self, content: FileContent, names: tuple[str, ...], lossy: bool) -> Proof:
        found = differences(self.splats, content, *names)
        by_camera = self._decibels(content, found.rows)
        worst = min(by_camera, default=IDENTICAL_DB)
        figures = {
            "verify_db": round(worst, 2),
            "verify_mean_db": round(float(np.mean(by_camera)), 2) if by_camera else worst,
            "verify_cameras": len(by_camera),
            **found.largest,
            "worst_attribute": found.worst,
            "worst_splat": found.worst_row,
        }
        fault = diagnosis.explain(self.splats, content, found)
        if not lossy and worst < _LOSSLESS_DB:
            drawn = f"drawn again it differs by {worst:.1f} dB"
            fault = f"{drawn}; {fault}" if fault else drawn
        loss_db = worst if lossy and worst < _LOSSY_DB and not fault else None
        return Proof(len(content.splats), figures, fault, loss_db)

    def _decibels(self, content: FileContent, rows: Rows) -> list[float]:
        """By camera; rows: see `Differences`. The camera is moved into the file's axes, not the
        file's splats into ours: so the turn of positions, rotations and SH is checked by something
        other than itself."""
        drawn = self.drawn if isinstance(self.drawn, slice) else self.drawn[rows]
        draw = renderer(content.splats.take(drawn), raster_settings_of(self.splats), self.backend)
        moved = (camera.moved(content.world_from_file) for camera in self.cameras)
        return [
            capped_psnr_db(draw(camera).image, np.clip(picture, 0.0, 1.0))
            for camera, picture in zip(moved, self.pictures, strict=True)
        ]


def _middle(splats: Splats) -> NDArray[np.bool_] | slice:
    """Rows that are drawn: all, or the `_MOST_DRAWN` nearest to the middle."""
    if len(splats) <= _MOST_DRAWN:
        return slice(None)
    middle = [np.median(splats.means[:, axis]) for axis in range(3)]
    far = np.empty(len(splats), np.float32)
    for rows in blocks(len(splats)):
        far[rows] = np.linalg.norm(splats.means[rows] - middle, axis=1)
    drawn = np.zeros(len(splats), bool)
    drawn[np.argpartition(far, _MOST_DRAWN)[:_MOST_DRAWN]] = True
    return drawn


def _drawable(content: FileContent) -> FileContent:
    """Without what no viewer can draw. Infinite logarithms, of flat and of opaque splats, become
    numbers, as the readers that are checked make them."""
    splats = content.splats
    if not (np.isfinite(splats.log_scales).all() and np.isfinite(splats.opacity_logits).all()):
        splats = replace(
            splats,
            log_scales=np.where(
                np.isneginf(splats.log_scales), np.float32(LOG_SCALE_MIN), splats.log_scales
            ),
            opacity_logits=np.where(
                np.isinf(splats.opacity_logits),
                np.clip(splats.opacity_logits, LOGIT_MIN, LOGIT_MAX),
                splats.opacity_logits,
            ),
        )
    return replace(content, splats=drop_undrawable(splats)[0])


def _words(error: Exception) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__
