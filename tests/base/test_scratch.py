"""Large arrays lie on a disk that is named, and leave nothing there."""

from __future__ import annotations

import gc
import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from stages.base import scratch
from stages.base.errors import SplatError
from stages.base.row_slices import row_slices


@pytest.fixture(autouse=True)
def _small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scratch, "LARGE_BYTES", 1 << 10)


def test_large_arrays_are_mapped_where_a_place_is_named_and_small_ones_never(
    tmp_path: Path,
) -> None:
    assert type(scratch.empty((1000,))) is np.ndarray
    with scratch.scratch_in(tmp_path):
        assert type(scratch.empty((10,))) is np.ndarray
        found = scratch.empty((1000, 3), np.float64)
    assert isinstance(found, np.memmap)
    assert (found.shape, found.dtype) == ((1000, 3), np.float64)


def test_values_stay_when_their_pages_are_let_go(tmp_path: Path) -> None:
    with scratch.scratch_in(tmp_path):
        found = scratch.empty((5000,))
    for rows in row_slices(5000, 100):
        found[rows] = np.arange(rows.start, rows.stop)
    assert (found == np.arange(5000)).all()


def test_nothing_is_left_behind(tmp_path: Path) -> None:
    with scratch.scratch_in(tmp_path):
        found = scratch.empty((5000,))
        assert not list(tmp_path.iterdir()), "a name would stay if the process were killed"
    found[:] = 1
    del found
    gc.collect()
    assert not list(tmp_path.iterdir())


def test_a_disk_without_room_is_said_before_anything_is_written(tmp_path: Path) -> None:
    with scratch.scratch_in(tmp_path), pytest.raises(SplatError) as refused:
        scratch.empty((1 << 44,))
    assert refused.value.code == "disk-full"


def test_where_a_disk_only_helps_memory_does_without_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with scratch.scratch_in(tmp_path, spare=True):
        assert isinstance(scratch.empty((1000,)), np.memmap)
    with scratch.scratch_in(tmp_path / "none", spare=True):
        assert type(scratch.empty((1000,))) is np.ndarray
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: SimpleNamespace(free=7000))
    with scratch.scratch_in(tmp_path, spare=True):
        assert type(scratch.empty((1000,))) is np.ndarray, "the rest is for what is written"
