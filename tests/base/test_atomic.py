"""Files are replaced whole; incomplete files of processes that ended are removed."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from pathlib import Path

import pytest

from stages.base.atomic import partial_prefix, remove_abandoned_files, replacing


def ended() -> str:
    """The prefix of a process that has ended."""
    code = "from stages.base.atomic import partial_prefix; print(partial_prefix())"
    command = [sys.executable, "-c", code]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


def test_what_a_killed_process_left_goes_and_what_lives_stays(tmp_path: Path) -> None:
    dead = ended()
    (tmp_path / f"{dead}a.ply").write_text("half")
    (tmp_path / f"{dead}chunks").mkdir()
    (tmp_path / f"{dead}chunks" / "0_0").mkdir()
    machine, process = dead.removeprefix(".partial-").split("-")[:2]
    elsewhere = f".partial-{int(machine, 16) ^ 1:08x}-{process}-a.ply"
    stays = {"a.ply", ".partial-a.ply", f"{partial_prefix()}b.ply", elsewhere}
    for name in stays:
        (tmp_path / name).touch()
    remove_abandoned_files(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == stays


def test_a_folder_that_is_not_there_is_no_error_of_its_own(tmp_path: Path) -> None:
    remove_abandoned_files(tmp_path / "none")


@pytest.mark.parametrize("name", ["n" * 251 + ".jpg", "\u00fc" * 124 + ".webp"])
def test_names_as_long_as_file_systems_allow_are_written(tmp_path: Path, name: str) -> None:
    with replacing(tmp_path / name) as path:
        assert path.suffix == Path(name).suffix
        path.write_text("a")
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_file_and_then_folder_are_flushed_to_the_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    flushed: list[int] = []
    monkeypatch.setattr(os, "fsync", lambda file: flushed.append(os.fstat(file).st_ino))
    with replacing(tmp_path / "a.txt") as path:
        path.write_text("a")
    assert flushed == [(tmp_path / "a.txt").stat().st_ino, tmp_path.stat().st_ino]


def test_folder_that_cannot_be_flushed_is_no_failure(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def files_only(file: int) -> None:
        if os.fstat(file).st_ino == tmp_path.stat().st_ino:
            raise OSError(errno.EINVAL, "Invalid argument")

    monkeypatch.setattr(os, "fsync", files_only)
    with replacing(tmp_path / "a.txt") as path:
        path.write_text("a")
    assert (tmp_path / "a.txt").read_text() == "a"
