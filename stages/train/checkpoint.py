"""The checkpoint of a run: everything that the next step depends on, in one file with a checksum.

The two newest checkpoints are kept, so that a damaged file costs the steps since the one before it.

Random numbers depend on the seed and the step alone, so no generator is stored.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from stages.base.atomic import rename, sync_folder
from stages.raster.backends import backend_of
from stages.train.average import ParameterAverage
from stages.train.clock import Elapsed
from stages.train.history import HistoryEntry
from stages.train.optimiser import Model

FILE_NAME = "checkpoint.bin"
MAGIC = b"SPLATC16"
_PREVIOUS = "checkpoint-previous.bin"
_TEMPORARY = FILE_NAME + ".tmp"
_CHUNK_BYTES = 1 << 20


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
        history: the evaluations.
        times: of each entry of the history, and, last, now.
        provenance: one entry for each change of backend or device.
        refinement: of cameras, see `camera_refinement`; None where they stay as they are.
        transient: for each training view [h, w] the parts that show what moved.
        average: of the parameters over the last steps.
    """

    step: int
    plan: tuple[int, int, float]
    history: list[HistoryEntry]
    times: list[Elapsed]
    provenance: list[Provenance]
    refinement: dict[str, Any] | None = None
    transient: list[NDArray[np.bool_]] = field(default_factory=list)
    average: ParameterAverage = field(default_factory=ParameterAverage)


def save_checkpoint(folder: Path, model: Model, state: TrainingState) -> None:
    """Write the checkpoint, once it is complete, under its name; the one before it is kept."""
    path, temporary = folder / FILE_NAME, folder / _TEMPORARY
    with temporary.open("w+b") as file:
        average = state.average
        written = dataclasses.asdict(dataclasses.replace(state, average=ParameterAverage()))
        written["average"] = average.count, len(average.arrays)
        header = json.dumps(written, default=_as_rows).encode()
        file.write(MAGIC + len(header).to_bytes(8, "little") + header)
        for array in (*vars(model).values(), *average.arrays):
            npy.write_array(file, array, allow_pickle=False)
        file.seek(0)
        file.write(hashlib.file_digest(file, "sha256").digest())
        file.flush()
        os.fsync(file.fileno())
    if path.exists():
        rename(path, folder / _PREVIOUS)
    rename(temporary, path)
    sync_folder(folder)


def _as_rows(array: NDArray[np.bool_]) -> object:
    return array.astype(np.uint8).tolist()


def load_checkpoint(
    folder: Path, warn: Callable[[str, str], None]
) -> tuple[Model, TrainingState] | None:
    """The newest checkpoint that is whole, or None.

    A damaged one is renamed, and reported as warn(code, message).
    """
    for name in (FILE_NAME, _PREVIOUS):
        path = folder / name
        if not path.exists():
            continue
        with suppress(OSError), path.open("rb") as file:
            if _is_whole(file):
                return _read(file)
        aside = path.with_stem(f"{path.stem}-damaged")
        with suppress(OSError):
            rename(path, aside)
        warn(
            "train-checkpoint-damaged",
            f"A checkpoint is damaged: its checksum does not fit. It was renamed to {aside.name}; "
            "training goes on from the one before it, or from its start. Check the disk.",
        )
    return None


def _is_whole(file: BinaryIO) -> bool:
    """Whether the file ends in the SHA-256 of what is before it. Goes back to its start."""
    sha256 = hashlib.sha256()
    left = file.seek(0, os.SEEK_END) - sha256.digest_size
    file.seek(0)
    while left > 0 and (data := file.read(min(left, _CHUNK_BYTES))):
        sha256.update(data)
        left -= len(data)
    whole = left == 0 and file.read() == sha256.digest()
    file.seek(0)
    return whole and file.read(len(MAGIC)) == MAGIC


def _read(file: BinaryIO) -> tuple[Model, TrainingState]:
    """The contents of a whole checkpoint, read from the end of its magic number on."""
    header = json.loads(file.read(int.from_bytes(file.read(8), "little")))
    arrays = [npy.read_array(file, allow_pickle=False) for _ in dataclasses.fields(Model)]
    header["history"] = [HistoryEntry(**entry) for entry in header["history"]]
    header["times"] = [Elapsed(**entry) for entry in header["times"]]
    header["provenance"] = [Provenance(**entry) for entry in header["provenance"]]
    count, averaged = header["average"]
    means = [npy.read_array(file, allow_pickle=False) for _ in range(averaged)]
    header["average"] = ParameterAverage(count, means)
    header["transient"] = [np.array(rows, np.bool_) for rows in header["transient"]]
    state = TrainingState(**header | {"plan": tuple(header["plan"])})
    return Model(*(np.ascontiguousarray(a) for a in arrays)), state


def remove_checkpoint(folder: Path) -> None:
    """Remove the files of a finished run, damaged ones included: they are no output."""
    for path in folder.glob("checkpoint*.bin*"):
        path.unlink()
