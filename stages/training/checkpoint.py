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

from stages.base.atomic import replacing
from stages.training.clock import Elapsed
from stages.training.optimiser import Model
from stages.training.validation import Answer, Trial

FILE_NAME = "checkpoint.bin"
MAGIC = b"SPLATCP9"
KEPT = "model-{}.bin"  # after so many steps


@dataclass(frozen=True)
class Provenance:
    """What made the steps from `step` on: a backend, on a device."""

    step: int
    backend: str
    device: str


@dataclass(frozen=True)
class TrainingState:
    """What is told of a run besides its model. step: done. plan: (steps in all, since when, share
    done by then), see `schedule.Schedule`. history: as logged. trial, answers, stopped: whether
    lent photographs are being asked, what they said, and whether growth ended for it. times: of
    each entry of the history, and, last, now. makers: one after the other."""

    step: int
    plan: tuple[int, int, float]
    history: list[dict[str, Any]]
    trial: Trial | None
    answers: list[Answer]
    stopped: bool
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
        Trial(**_with_tuples(header["trial"])) if header["trial"] else None,
        [Answer(**_with_tuples(answer)) for answer in header["answers"]],
        header["stopped"],
        [Elapsed(**t) for t in header["times"]],
        [Provenance(**maker) for maker in header["makers"]],
    )
    asked_of = [saved.trial.begun] if saved.trial else []
    asked_of += [answer.step for answer in saved.answers]
    if not all((folder / KEPT.format(step)).exists() for step in asked_of):
        return None
    return model, saved


def _with_tuples(told: dict[str, Any]) -> dict[str, Any]:
    """As it was: JSON knows lists alone."""
    return {key: tuple(value) if isinstance(value, list) else value for key, value in told.items()}


def checkpoint_files(folder: Path) -> list[str]:
    """Names of all that `load_checkpoint` and `kept_model` read, the checkpoint itself last."""
    return [*sorted(path.name for path in folder.glob(KEPT.format("*"))), FILE_NAME]


def keep_model(folder: Path, step: int, model: Model) -> None:
    """Put the model after `step` steps aside until the stage is finished. Raises SplatError."""
    with replacing(folder / KEPT.format(step)) as temporary, temporary.open("wb") as file:
        _write(file, model)


def kept_model(folder: Path, step: int) -> Model:
    """What `keep_model` put aside."""
    with (folder / KEPT.format(step)).open("rb") as file:
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
    for name in (*checkpoint_files(folder), f"{FILE_NAME}.tmp"):
        (folder / name).unlink(missing_ok=True)
