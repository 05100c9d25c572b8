"""Checkpoints are read back as written, or not at all."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from stages.train.checkpoint import (
    FILE_NAME,
    TrainingState,
    load_checkpoint,
    remove_checkpoint,
    save_checkpoint,
)
from stages.train.history import HistoryEntry
from stages.train.optimiser import Model, new_model
from tests.scenes import cloud

Warnings = list[tuple[str, str]]


def save(folder: Path, step: int) -> None:
    state = TrainingState(step, (30, 0, 0.0), [HistoryEntry(step, 5)], [], [])
    save_checkpoint(folder, model(step), state)


def load(folder: Path) -> tuple[int | None, Warnings]:
    """(step of the checkpoint or None, warnings)."""
    warnings: Warnings = []
    found = load_checkpoint(folder, lambda code, message: warnings.append((code, message)))
    if found is None:
        return None, warnings
    for a, b in zip(vars(found[0]).values(), vars(model(found[1].step)).values(), strict=True):
        assert a.tobytes() == b.tobytes()
    return found[1].step, warnings


def flip_bit(path: Path, at: int) -> None:
    data = bytearray(path.read_bytes())
    data[at] ^= 1
    path.write_bytes(data)


def model(step: int) -> Model:
    start = cloud(20, degree=1, seed=step)
    parameters = (start.means, start.quaternions, start.log_scales, start.opacity_logits, start.sh)
    return new_model(*(np.asarray(values, np.float32) for values in parameters))


def test_the_newest_checkpoint_is_read(tmp_path: Path) -> None:
    assert load(tmp_path) == (None, [])
    for step in (10, 20, 30):
        save(tmp_path, step)
        assert load(tmp_path) == (step, [])


def test_any_flipped_bit_is_noticed_and_the_checkpoint_before_is_read(tmp_path: Path) -> None:
    save(tmp_path, 10)
    save(tmp_path, 20)
    whole = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    size = len(whole[FILE_NAME])
    for at in (0, 8, 15, 16, 40, *range(100, size, size // 20), size - 33, size - 32, size - 1):
        for name, data in whole.items():
            (tmp_path / name).write_bytes(data)
        flip_bit(tmp_path / FILE_NAME, at)
        step, warnings = load(tmp_path)
        assert step == 10, at
        ((code, message),) = warnings
        assert code == "train-checkpoint-damaged"
        assert "checkpoint-damaged.bin" in message
        assert (tmp_path / "checkpoint-damaged.bin").stat().st_size == size
        assert load(tmp_path) == (10, [])  # reported once


@pytest.mark.parametrize("size", [0, 5, 31, 32, 40, 1000])
def test_a_shortened_checkpoint_is_damaged(tmp_path: Path, size: int) -> None:
    save(tmp_path, 10)
    path = tmp_path / FILE_NAME
    path.write_bytes(path.read_bytes()[:size])
    step, warnings = load(tmp_path)
    assert step is None
    assert len(warnings) == 1


def test_training_begins_again_if_both_checkpoints_are_damaged(tmp_path: Path) -> None:
    save(tmp_path, 10)
    save(tmp_path, 20)
    for path in tmp_path.iterdir():
        flip_bit(path, 100)
    step, warnings = load(tmp_path)
    assert step is None
    assert len(warnings) == 2
    save(tmp_path, 5)
    assert load(tmp_path) == (5, [])
    remove_checkpoint(tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_a_kill_between_the_two_renames_loses_the_newest_steps_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    save(tmp_path, 10)
    rename, renames = os.replace, iter([True, False])

    def killed(source: Path, target: Path) -> None:
        if not next(renames):
            raise KeyboardInterrupt
        rename(source, target)

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", killed)
        with pytest.raises(KeyboardInterrupt):
            save(tmp_path, 20)
    assert load(tmp_path) == (10, [])
    save(tmp_path, 30)
    assert load(tmp_path) == (30, [])
