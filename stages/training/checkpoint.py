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

from stages.training.clock import Spent
from stages.training.optimiser import Model
from stages.training.pace import Mark
from stages.training.trial import BEFORE, PLAIN, Trial

FILE_NAME = "checkpoint.bin"
MAGIC = b"SPLATCP8"


@dataclass(frozen=True)
class Maker:
    """What made the steps from `step` on: a backend, on a device."""

    step: int
    backend: str
    device: str


@dataclass(frozen=True)
class Saved:
    """What is told of a run besides its model. step: done. plan: (steps in all, since when, share
    done by then), see `schedule.Schedule`. history: as logged. marks: of the
    photographs that decide. trial, gain_db: whether they are being asked, and what came out.
    times: of each entry of the history, and, last, now. makers: one after the other."""

    step: int
    plan: tuple[int, int, float]
    history: list[dict[str, Any]]
    marks: list[Mark]
    trial: Trial | None
    gain_db: float | None
    times: list[Spent]
    makers: list[Maker]


def save_checkpoint(folder: Path, model: Model, saved: Saved) -> None:
    """Write the state after a step; a checkpoint that stands there stays until this is whole.

    Random numbers depend on the seed and the step alone, so they need no place.
    """
    temporary = folder / (FILE_NAME + ".tmp")
    with temporary.open("wb") as file:
        header = json.dumps(dataclasses.asdict(saved)).encode()
        file.write(MAGIC + len(header).to_bytes(8, "little") + header)
        _write(file, model)
    os.replace(temporary, folder / FILE_NAME)


def load_checkpoint(folder: Path) -> tuple[Model, Saved] | None:
    """What was saved, or None where there is none or it cannot be read."""
    try:
        with (folder / FILE_NAME).open("rb") as file:
            if file.read(8) != MAGIC:
                return None
            header = json.loads(file.read(int.from_bytes(file.read(8), "little")))
            model = _read(file)
    except (OSError, ValueError, EOFError, MemoryError):
        return None
    steps, since, share = header["plan"]
    saved = Saved(
        int(header["step"]),
        (int(steps), int(since), float(share)),
        header["history"],
        [Mark(**mark) for mark in header["marks"]],
        Trial(**header["trial"]) if header["trial"] else None,
        header["gain_db"],
        [Spent(**t) for t in header["times"]],
        [Maker(**maker) for maker in header["makers"]],
    )
    return model, saved


def keep_model(folder: Path, name: str, model: Model) -> None:
    """Put a model aside until the stage is finished."""
    temporary = folder / f"{name}.bin.tmp"
    with temporary.open("wb") as file:
        _write(file, model)
    os.replace(temporary, folder / f"{name}.bin")


def kept_model(folder: Path, name: str) -> Model:
    """What `keep_model` put aside."""
    with (folder / f"{name}.bin").open("rb") as file:
        return _read(file)


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
    for name in (FILE_NAME, f"{BEFORE}.bin", f"{PLAIN}.bin"):
        (folder / name).unlink(missing_ok=True)
        (folder / f"{name}.tmp").unlink(missing_ok=True)
