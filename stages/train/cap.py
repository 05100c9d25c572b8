"""The largest number of splats of a run. It is chosen at the first start and kept on resumption.

Without --max-splats it is the smaller of two: what half of the free memory holds, and the number of
splats that have as many parameters as the training views have pixel values. --splats-per-view may
lower either.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from stages.base.atomic import replacing
from stages.base.memory import available_mib, training_mib
from stages.scene import Camera, parameters_per_splat
from stages.train.optimiser import Model

FILE_NAME = "cap.json"
FREE_MEMORY = "free memory"
DEVICE_MEMORY = "the GPU's memory"
PHOTOGRAPHS = "the photographs' pixels"
VIEWS = "--splats-per-view"
MIN_CAP = 10_000  # splats that are always allowed
BASE_MIB = 2048.0  # libraries, and at most 1 GiB of photographs


@dataclass(frozen=True)
class Cap:
    """The cap and its reason.

    Args:
        splats: the largest number allowed.
        origin: "--max-splats", VIEWS, FREE_MEMORY, PHOTOGRAPHS or DEVICE_MEMORY.
        free_mib: memory that was free, if that decided.
    """

    splats: int
    origin: str
    free_mib: float | None = None

    def for_given(self, splats: int) -> Cap:
        """At least so many, which were trained before: only a GPU's memory leaves some out."""
        if self.origin == DEVICE_MEMORY or self.splats >= splats:
            return self
        return replace(self, splats=splats)


def splat_cap(free_mib: float) -> int:
    """How many splats can be trained in half of the free memory."""
    return max(MIN_CAP, int(0.5 * free_mib / training_mib(1)))


def needed_mib(splats: int) -> float:
    """Memory of one run, all its stages, that trains at most `splats` splats."""
    return BASE_MIB + training_mib(splats)


def cap_for(folder: Path, max_splats: int, determined: int, by_views: int = 0) -> Cap:
    """The cap of the run in `folder`.

    A resumed run keeps the cap that was chosen first, because another one would give other bytes. A
    cap that a GPU's memory enforced holds for every later start.

    Args:
        max_splats: as the user set it; 0 for automatic.
        determined: see `splats_determined`.
        by_views: what --splats-per-view allows; 0 for any number.
    """
    kept = _read(folder / FILE_NAME)
    if kept is not None and (not max_splats or kept.origin == DEVICE_MEMORY):
        return kept
    caps = [Cap(by_views, VIEWS)] if by_views else []
    if max_splats:
        return min([Cap(max_splats, "--max-splats"), *caps], key=lambda cap: cap.splats)
    free_mib = available_mib()
    by_memory = Cap(splat_cap(free_mib), FREE_MEMORY, round(free_mib))
    caps += [by_memory, Cap(determined, PHOTOGRAPHS)]
    return _saved(min(caps, key=lambda cap: cap.splats), folder)


def splats_determined(cameras: Sequence[Camera], sh_degree: int) -> int:
    """How many splats of `sh_degree` have no more parameters than the views of `cameras` have pixel
    values. Of more splats, some would be undetermined."""
    return max(MIN_CAP, pixel_values(cameras) // int(parameters_per_splat(np.array(sh_degree))))


def pixel_values(cameras: Sequence[Camera]) -> int:
    """How many pixel values the views of `cameras` have: three for each pixel."""
    return sum(3 * camera.width * camera.height for camera in cameras)


def lower_cap(folder: Path, splats: int) -> Cap:
    """Set the cap to what a GPU's memory holds, also for later starts."""
    return _saved(Cap(splats, DEVICE_MEMORY), folder)


def most_opaque(model: Model, cap: int) -> Model:
    """The `cap` most opaque splats in their order; the model itself if it has no more."""
    if len(model) <= cap:
        return model
    strongest = np.argsort(-model.opacity_logits, kind="stable")[:cap]
    return model.take(np.sort(strongest))


def remove_cap(folder: Path) -> None:
    """Remove the file after a finished run, whose manifest holds the cap."""
    (folder / FILE_NAME).unlink(missing_ok=True)


def _saved(cap: Cap, folder: Path) -> Cap:
    with replacing(folder / FILE_NAME) as path:
        path.write_text(json.dumps(asdict(cap)) + "\n", encoding="utf-8")
    return cap


def _read(path: Path) -> Cap | None:
    try:
        cap = Cap(**json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError):
        return None
    return cap if isinstance(cap.splats, int) and cap.splats > 0 else None
