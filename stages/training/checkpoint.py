"""The checkpoint of a run: everything that the next step depends on, in one file.

Random numbers depend on the seed and the step alone, so no generator is stored.
"""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy

from stages.raster.backends import backend_of
from stages.training.clock import Elapsed
from stages.training.optimiser import Model
from stages.training.validation import EarlyStopping

FILE_NAME = "checkpoint.bin"
MAGIC = b"SPLATC10"


@dataclass(frozen=True)
class Provenance:
    """What computed the steps from `step` on: a backend, on a device."""

    step: int
    backend: str
    device: str

    @classmethod
    def of_backend(cls, step: int, backend: str) -> Provenance:
        """Of the backend of this name, or the one that "auto" stands for."""
        chosen = backend_of(backend)
        return cls(step, chosen.name, chosen.describe())

    def change_since(self, before: Sequence[Provenance]) -> str:
        """What changed since the last of `before`, in words; "" for nothing."""
        if not before or dataclasses.replace(self, step=before[-1].step) == before[-1]:
            return ""
        return f"resuming with {self.backend} what {before[-1].backend} began"


@dataclass(frozen=True)
class TrainingState:
    """The state of a run apart from its model.

    Args:
        step: number of steps done.
        plan: (steps in all, step of the last change of the plan, share of the run done by then),
            see `schedule.Schedule`.
        history: results of evaluations.
        early_stopping: of densification, with its best values so far.
        times: of each entry of the history, and, last, now.
        provenance: one entry for each change of backend or device.
    """

    step: int
    plan: tuple[int, int, float]
    history: list[dict[str, Any]]
    early_stopping: EarlyStopping
    times: list[Elapsed]
    provenance: list[Provenance]


def save_checkpoint(folder: Path, model: Model, state: TrainingState) -> None:
    """Write the checkpoint; the previous one is replaced once the new one is complete."""
    temporary = folder / (FILE_NAME + ".tmp")
    with temporary.open("wb") as file:
        header = json.dumps(dataclasses.asdict(state)).encode()
        file.write(MAGIC + len(header).to_bytes(8, "little") + header)
        for array in vars(model).values():
            npy.write_array(file, array, allow_pickle=False)
        file.flush()
        os.fsync(file.fileno())
    os.replace(temporary, folder / FILE_NAME)


def load_checkpoint(folder: Path) -> tuple[Model, TrainingState] | None:
    """What was saved; None if there is no checkpoint or it is damaged."""
    try:
        with (folder / FILE_NAME).open("rb") as file:
            if file.read(8) != MAGIC:
                return None
            header = json.loads(file.read(int.from_bytes(file.read(8), "little")))
            arrays = [npy.read_array(file, allow_pickle=False) for _ in dataclasses.fields(Model)]
    except (OSError, ValueError, EOFError, MemoryError):
        return None
    steps, since, share = header["plan"]
    stopping = header["early_stopping"]
    state = TrainingState(
        int(header["step"]),
        (int(steps), int(since), float(share)),
        header["history"],
        EarlyStopping(**stopping | {"rows": tuple(stopping["rows"])}),
        [Elapsed(**t) for t in header["times"]],
        [Provenance(**entry) for entry in header["provenance"]],
    )
    return Model(*(np.ascontiguousarray(a) for a in arrays)), state


def remove_checkpoint(folder: Path) -> None:
    """Remove the files of a finished run."""
    for name in (FILE_NAME, f"{FILE_NAME}.tmp"):
        (folder / name).unlink(missing_ok=True)
