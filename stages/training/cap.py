"""How many splats a run may have: decided at its first start, and kept by its later ones."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from stages.base.atomic import replacing
from stages.base.memory import available_mib
from stages.scene import Camera, parameters_per_splat
from stages.training.density import FEWEST, splat_cap
from stages.training.optimiser import Model

FILE_NAME = "cap.json"
DEVICE_MEMORY = "the GPU's memory"
PHOTOGRAPHS = "the photographs' pixels"


@dataclass(frozen=True)
class Cap:
    """splats: at most. origin: "--max-splats", "free memory", PHOTOGRAPHS or DEVICE_MEMORY.
    free_mib: what was free then, if that decided; None where the system did not say."""

    splats: int
    origin: str
    free_mib: float | None = None


def cap_for(folder: Path, max_splats: int, told: int) -> Cap:
    """`max_splats`, or for 0 what free memory allows, and no more than `told`: as it was when work
    in `folder` began, since a run that goes on with another cap would end in other bytes. Fewer, if
    a GPU has refused so many by then."""
    kept = _read(folder / FILE_NAME)
    if kept is not None and (not max_splats or kept.origin == DEVICE_MEMORY):
        return kept
    if max_splats:
        return Cap(max_splats, "--max-splats")
    free_mib = available_mib()
    held = Cap(splat_cap(free_mib), "free memory", free_mib and round(free_mib))
    return _kept(min(held, Cap(told, PHOTOGRAPHS), key=lambda cap: cap.splats), folder)


def splats_determined(cameras: Sequence[Camera], sh_degree: int) -> int:
    """How many splats of `sh_degree` have no more numbers than the photographs of `cameras`: with
    more, some are told by nothing."""
    numbers = sum(3 * camera.width * camera.height for camera in cameras)
    return max(FEWEST, numbers // int(parameters_per_splat(np.array(sh_degree))))


def lower_cap(folder: Path, splats: int) -> Cap:
    """No more than a GPU holds, from now on."""
    return _kept(Cap(splats, DEVICE_MEMORY), folder)


def most_opaque(model: Model, cap: int) -> Model:
    """The model, or of too large a one those splats that hide most."""
    if len(model) <= cap:
        return model
    strongest = np.argsort(-model.opacity_logits, kind="stable")[:cap]
    return model.take(np.sort(strongest))


def _kept(cap: Cap, folder: Path) -> Cap:
    with replacing(folder / FILE_NAME) as path:
        path.write_text(json.dumps(asdict(cap)) + "\n", encoding="utf-8")
    return cap


def remove_cap(folder: Path) -> None:
    """Of a finished run, whose manifest says what it was."""
    (folder / FILE_NAME).unlink(missing_ok=True)


def _read(path: Path) -> Cap | None:
    try:
        cap = Cap(**json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError):
        return None
    return cap if isinstance(cap.splats, int) and cap.splats > 0 else None
