"""Training's memory on disk: everything that the next step depends on, in one file."""

from __future__ import annotations

import dataclasses
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy

from stages.training.clock import Spent
from stages.training.optimiser import Model

FILE_NAME = "checkpoint.bin"
MAGIC = b"SPLATCP3"


def save_checkpoint(
    folder: Path, model: Model, step: int, history: list[dict[str, Any]], times: list[Spent]
) -> None:
    """Write the state after `step` steps; a checkpoint that stands there stays until this is whole.
    times: of each entry of the history, and, last, now.

    Random numbers and schedules depend on the seed and the step alone, so they need no place.
    """
    temporary = folder / (FILE_NAME + ".tmp")
    with temporary.open("wb") as file:
        spent = [[t.seconds, t.cpu_seconds] for t in times]
        header = json.dumps({"step": step, "history": history, "times": spent}).encode()
        file.write(MAGIC + len(header).to_bytes(8, "little") + header)
        for array in vars(model).values():
            npy.write_array(file, array, allow_pickle=False)
        file.flush()
        os.fsync(file.fileno())
    os.replace(temporary, folder / FILE_NAME)


def load_checkpoint(folder: Path) -> tuple[Model, int, list[dict[str, Any]], list[Spent]] | None:
    """(model, steps done, history, times), or None where there is none or it cannot be read."""
    try:
        with (folder / FILE_NAME).open("rb") as file:
            if file.read(8) != MAGIC:
                return None
            header = json.loads(file.read(int.from_bytes(file.read(8), "little")))
            arrays = [npy.read_array(file, allow_pickle=False) for _ in dataclasses.fields(Model)]
    except (OSError, ValueError, EOFError, MemoryError):
        return None
    model = Model(*(np.ascontiguousarray(a) for a in arrays))
    return model, int(header["step"]), header["history"], [Spent(*t) for t in header["times"]]


def remove_checkpoint(folder: Path) -> None:
    """A finished stage keeps its result, not its way there."""
    for name in (FILE_NAME, FILE_NAME + ".tmp"):
        (folder / name).unlink(missing_ok=True)
