"""Proof that a file holds the splats that it was made from.

An independent reader reads it back, the rasteriser draws it from held-out cameras, and every value
is compared with the original. Of more than `_MAX_DRAWN` splats only the central ones are drawn,
because drawing takes more memory than the splats themselves.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.base.errors import QualityError
from stages.base.row_slices import row_slices
from stages.base.text import reason_of
from stages.evaluate.image_metrics import IDENTICAL_DB, capped_psnr_db
from stages.formats import BY_ENDING, format_of
from stages.formats.codecs import CODECS
from stages.formats.compressed_ply import outlier_shells
from stages.formats.values import check_finite, drop_undrawable, nonfinite_allowed
from stages.proof import checks
from stages.proof.compare import Change, differences
from stages.proof.content import FileContent, NotCrossCheckedError
from stages.proof.matching import Rows
from stages.raster.backends import AUTO
from stages.raster.draw import raster_settings_of, renderer
from stages.scene import Camera, QuantisedSplats, Splats, View, evenly_spaced, split_held_out
from stages.scene.framing import orbit_cameras
from stages.scene.quantiles import quantiles

_SIDE_PX = 480
_CAMERAS = 3
_CENTRAL_SHARE = 0.5  # of the splats, to look at where no views are known
_MAX_DRAWN = 1 << 22
_MIN_LOSSLESS_DB = 45.0  # a file of a lossless format below this is wrong
_WARN_LOSSY_DB = 30.0  # a file of a lossy format below this gets a warning
_FAR = 1000  # times the extent of most splats
_REPORT = "Write another format, and report this with the file that was read."
DROP_OUTLIERS = "`splat edit --drop-floaters` removes outliers"
_WRONG = {
    "position": "most positions are wrong, by {:.2g} of the scene's extent",
    "log_scale": "most sizes are wrong, by a factor of e^{:.2g}",
    "opacity": "most opacities are wrong, by {:.2g}",
    "rotation": "most rotations are wrong, by {:.2g} degrees",
    "colour": "most colours are wrong, by {:.2g}",
    "sh": "most view-dependent colours are wrong, by {:.0%} of their squares",
}


@dataclass(frozen=True)
class Proof:
    """The result for one file.

    Attributes:
        splats: the number of splats in the file.
        figures: verify_db (the lowest PSNR of a camera between pictures of the original and of the
            file), verify_mean_db, verify_cameras, the largest errors of the values, and
            worst_attribute and worst_splat: the most visible error and its row in the file. Empty
            where nothing could be compared.
        fault: why the file is wrong; "" if it is not.
        loss_db: the PSNR of a lossy file where it calls for a warning, else None.
        changes: by attribute in which splats look different.
    """

    splats: int
    figures: dict[str, Any]
    fault: str = ""
    loss_db: float | None = None
    changes: dict[str, Change] = field(default_factory=dict)


def cameras_for(splats: Splats, views: Sequence[View] = ()) -> tuple[Camera, ...]:
    """Three cameras to compare from: held-out views spread over the capture; training views where
    none are held out; an orbit around the splats where there are no views."""
    training, held = split_held_out(tuple(views))
    chosen = held or training
    if not chosen:
        return tuple(
            camera.fitted(_SIDE_PX) for camera in orbit_cameras(splats, _CAMERAS, _CENTRAL_SHARE)
        )
    return tuple(view.camera.fitted(_SIDE_PX) for view in evenly_spaced(chosen, _CAMERAS))


@dataclass(frozen=True)
class Prover:
    """Compares files with one original, whose pictures are drawn once.

    Attributes:
        splats: the original; all drawable.
        drawn: the rows that are drawn.
        cameras, pictures: the original drawn from each camera, [H, W, 3].
        backend: the rasteriser.
        source_format: the format of the file that the original was read from; "" if it was not
            read from a file. After a lossy format, no format is expected to be lossless.
    """

    splats: Splats
    drawn: NDArray[np.bool_] | slice
    cameras: tuple[Camera, ...]
    pictures: tuple[NDArray[np.float32], ...]
    backend: str
    source_format: str

    @classmethod
    def of(
        cls,
        splats: Splats,
        cameras: tuple[Camera, ...],
        backend: str = AUTO,
        source_format: str = "",
    ) -> Prover:
        drawn = _central_rows(splats)
        draw = renderer(splats.take(drawn), raster_settings_of(splats), backend)
        pictures = tuple(draw(camera).image for camera in cameras)
        return cls(splats, drawn, cameras, pictures, backend, source_format)

    def require(self, path: Path, code: str) -> Proof:
        """The proof of a file that was just written. Raises SplatError `code` if it is wrong."""
        proof = self.prove(path)
        if proof.fault:
            raise QualityError(
                code,
                given=f"{path.name} came out wrong: {proof.fault}.",
                wanted="A file that another program reads as the same splats.",
                hint=". ".join(filter(None, (self._advice(path), _REPORT))),
            )
        return proof

    def _advice(self, path: Path) -> str:
        """How the splats would fit the format of `path` better; "" if they fit."""
        if advice := CODECS[format_of(path).ending].size_loss(self.splats)[1]:
            return advice
        if advice := _far_from_zero(self.splats.means):
            return advice
        return DROP_OUTLIERS if outlier_shells(self.splats.means).any() else ""

    def with_original(self, splats: Splats) -> Prover:
        """This prover for other values of the same splats. The pictures stay, so that all losses
        show in them, unless `splats` are to be drawn in another way."""
        if splats.draw_settings.antialias == self.splats.draw_settings.antialias:
            return replace(self, splats=splats)
        return Prover.of(splats, self.cameras, self.backend, self.source_format)

    def plain_drawing_db(self) -> float:
        """Mean PSNR between the pictures, drawn with opacity compensation, and what a viewer
        without it draws."""
        plain = self.with_original(self.splats.with_antialias(False))
        pairs = zip(plain.pictures, self.pictures, strict=True)
        return float(np.mean([capped_psnr_db(a, np.clip(b, 0.0, 1.0)) for a, b in pairs]))

    def prove(self, path: Path) -> Proof:
        """Read `path` with an independent reader, draw it and compare. Nothing is raised for a
        wrong file."""
        row = format_of(path)
        try:
            content = _drawable(checks.read_back(path))
            errors = checks.CHECKS[row.ending].validate(path)
        except NotCrossCheckedError as error:
            return Proof(0, {}, f"another reader does not understand {error}")
        except Exception as error:  # whatever the reader raises: the file is wrong
            return Proof(0, {}, f"another reader refused it ({reason_of(error)})")
        count = len(content.splats)
        if errors:
            return Proof(count, {}, f"its validator says: {errors[0]}")
        if count != len(self.splats):
            return Proof(count, {}, f"it holds {count} of {len(self.splats)} splats")
        names = tuple(filter(None, (row.ending, self.source_format)))
        lossy = any(BY_ENDING[name].loses for name in names)
        return self._compared(content, names, lossy)

    def _compared(self, content: FileContent, names: tuple[str, ...], lossy: bool) -> Proof:
        found = differences(self.splats, content, *names)
        by_camera = self._psnr_by_camera(content, found.rows)
        worst = min(by_camera, default=IDENTICAL_DB)
        figures = {
            "verify_db": round(worst, 2),
            "verify_mean_db": round(float(np.mean(by_camera)), 2) if by_camera else worst,
            "verify_cameras": len(by_camera),
            **found.largest,
            "worst_attribute": found.worst,
            "worst_splat": found.worst_row,
        }
        fault = " and ".join(_WRONG[name].format(error) for name, error in found.wrong.items())
        if "log_scale" in found.wrong and (why := CODECS[names[0]].size_loss(self.splats)[0]):
            fault = f"{fault} (the format {why})"
        if not lossy and worst < _MIN_LOSSLESS_DB:
            drawn = f"drawn again it differs by {worst:.1f} dB"
            fault = f"{drawn}; {fault}" if fault else drawn
        loss_db = worst if lossy and worst < _WARN_LOSSY_DB and not fault else None
        return Proof(len(content.splats), figures, fault, loss_db, found.changes)

    def _psnr_by_camera(self, content: FileContent, rows: Rows) -> list[float]:
        """PSNR by camera. rows: see `Differences`. The camera is moved into the axes of the file
        instead of the splats into ours, so that the rotation of positions, quaternions and SH is
        checked by other code than itself."""
        drawn = self.drawn if isinstance(self.drawn, slice) else self.drawn[rows]
        settings = replace(
            raster_settings_of(self.splats), antialias=content.splats.draw_settings.antialias
        )
        draw = renderer(content.splats.take(drawn), settings, self.backend)
        moved = (camera.moved(content.world_from_file) for camera in self.cameras)
        return [
            capped_psnr_db(draw(camera).image, np.clip(picture, 0.0, 1.0))
            for camera, picture in zip(moved, self.pictures, strict=True)
        ]


def provers_of(
    quantised: QuantisedSplats, cameras: tuple[Camera, ...], backend: str
) -> Callable[[Splats], Prover]:
    """A function that gives the prover for the splats of a file of a run. It compares with pictures
    of the run's own splats, drawn as the file is, so that all losses of the format show."""
    originals = [s for s in (quantised.splats, quantised.plain) if s is not None]
    provers = {
        splats.draw_settings.antialias: Prover.of(drop_undrawable(splats)[0], cameras, backend)
        for splats in originals
    }
    return lambda held: provers.get(
        held.draw_settings.antialias, next(iter(provers.values()))
    ).with_original(held)


def _far_from_zero(means: NDArray[np.floating]) -> str:
    """The advice to move splats that lie farther from zero, as on a map grid, than a format has
    steps for; "" if they do not."""
    low, middle, high = quantiles(means, (0.1, 0.5, 0.9))
    if np.abs(middle).max() < _FAR * (high - low).max():
        return ""
    move = ",".join(f"{-round(value):d}" for value in middle)
    return f"`splat edit --move={move}` brings them near zero, where formats have finer steps"


def _central_rows(splats: Splats) -> NDArray[np.bool_] | slice:
    """The rows that are drawn: all, or the `_MAX_DRAWN` nearest to the median."""
    if len(splats) <= _MAX_DRAWN:
        return slice(None)
    middle = [np.median(splats.means[:, axis]) for axis in range(3)]
    far = np.empty(len(splats), np.float32)
    for rows in row_slices(len(splats)):
        far[rows] = np.linalg.norm(splats.means[rows] - middle, axis=1)
    drawn = np.zeros(len(splats), bool)
    drawn[np.argpartition(far, _MAX_DRAWN)[:_MAX_DRAWN]] = True
    return drawn


def _drawable(content: FileContent) -> FileContent:
    """The drawable splats. Infinite logarithms of flat and opaque splats become finite, as in our
    readers."""
    with nonfinite_allowed():
        return replace(content, splats=drop_undrawable(check_finite(content.splats))[0])
