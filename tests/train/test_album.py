"""Many pictures in little memory."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from stages.base.memory import resident_mib
from stages.train.album import Album

MIB = 2**20


def filled(folder: Path, count: int, size: int, resident_mib: float) -> Album:
    with Album(folder, resident_mib) as album:
        for number in range(count):
            assert album.add(np.full((3, 1, size), number % 251, np.uint8)) == number
    return album


def test_pictures_come_back_as_they_were_in_any_order(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    pictures = [rng.integers(0, 256, (3, *rng.integers(1, 200, 2)), np.uint8) for _ in range(40)]
    with Album(tmp_path, resident_mib=0.1) as album:
        for picture in pictures:
            album.add(picture)
    for number in rng.permutation(40).tolist() * 3:
        album.expect((number * 7) % 40)
        found = album.picture(number)
        assert found.shape == pictures[number].shape
        assert (found == pictures[number]).all()


def test_an_array_that_is_no_block_of_memory_is_kept_as_it_looks(tmp_path: Path) -> None:
    picture = np.arange(60, dtype=np.uint8).reshape(4, 5, 3)
    with Album(tmp_path) as album:
        album.add(picture.transpose(2, 0, 1))
    assert (album.picture(0) == picture.transpose(2, 0, 1)).all()


def test_nothing_is_left_in_the_folder(tmp_path: Path) -> None:
    album = filled(tmp_path / "work", 3, 10, 1)
    assert album.picture(2)[0, 0, 0] == 2
    assert list((tmp_path / "work").iterdir()) == []


def test_pictures_beyond_the_bound_are_given_back(tmp_path: Path) -> None:
    """960 MiB of pictures cost no more than what the album may keep, and half of that again
    for a picture of 24 MiB that comes when it is nearly full."""
    album = filled(tmp_path, 40, 8 * MIB, resident_mib=64)
    before = resident_mib()
    if not before:
        pytest.skip("this system does not say what a process holds")
    most = 0.0
    for number in range(40):
        assert int(album.picture(number)[:, :, ::4096].max()) == number % 251
        most = max(most, resident_mib() - before)
    assert 20 < most < 96
