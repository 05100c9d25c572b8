"""Training's memory on disk: everything that the next step depends on, in one file."""

from __future__ import annotations

import dataclasses
import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.lib import format as npy

from stages.training.clock import Elapsed
from stages.training.optimiser import Model

FILE_NAME = "checkpoint.bin"
MAGIC = b"SPLATC10"


@dataclass(frozen=True)
class Provenance:
    """What made the steps from `step` on: a backend, on a device."""

    step: int
    backend: str
    device: str


@dataclass(frozen=True)
class TrainingState:
    """What is told of a run besides its model. step: done. plan: (steps in all, since when, share
    done by then), see `schedule.Schedule`. history: as logged. validation_best_db,
    densification_stopped_at: see `validation.EarlyStopping`. times: of each entry of the history,
    and, last, now. makers: one after the other."""

    step: int
    plan: tuple[int, int, float]
    history: list[dict[str, Any]]
    validation_best_db: list[float]
    densification_stopped_at: int
    times: list[Elapsed]
    makers: list[Provenance]


def save_checkpoint(folder: Path, model: Model, saved: TrainingState) -> None:
    """Write the state after a step; a checkpoint that stands there stays until this is whole.

    Random numbers depend on the seed and the step alone, so they need no place.
    """
    temporary = folder / (FILE_NAME + ".tmp")
    with temporary.open("wb") as file:
        header = json.dumps(dataclasses.asdict(saved)).encode()
        file.write(MAGIC + len(header).to_bytes(8, "little") + header)
        _write(file, model)
    os.replace(temporary, folder / FILE_NAME)


def load_checkpoint(folder: Path) -> tuple[Model, TrainingState] | None:
    """What was saved, or None where there is none, or something of it is missing or damaged."""
    try:
        with (folder / FILE_NAME).open("rb") as file:
            if file.read(8) != MAGIC:
                return None
            header = json.loads(file.read(int.from_bytes(file.read(8), "little")))
            model = _read(file)
    except (OSError, ValueError, EOFError, MemoryError):
        return None
    steps, since, share = header["plan"]
    saved = TrainingState(
        int(header["step"]),
        (int(steps), int(since), float(share)),
        header["history"],
        header["validation_best_db"],
        header["densification_stopped_at"],
        [Elapsed(**t) for t in header["times"]],
        [Provenance(**maker) for maker in header["makers"]],
    )
    return model, saved


def _write(file: BinaryIO, model: Model) -> None:
    for array in vars(model).values():
        npy.write_array(file, array, allow_pickle=False)
    file.flush()
    os.fsync(file.fileno())


def _read(file: BinaryIO) -> Model:
    arrays = [npy.read_array(file, allow_pickle=False) for _ in dataclasses.fields(Model)]
    return Model(*(np.ascontiguousarray(a) for a in arrays))


def remove_checkpoint(folder: Path) -> None:
    """A finished stage keeps its result, not its way there."""
    for name in (FILE_NAME, f"{FILE_NAME}.tmp"):
        (folder / name).unlink(missing_ok=True)
