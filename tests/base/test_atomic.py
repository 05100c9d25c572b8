"""Files are replaced whole; incomplete files of processes that ended are removed."""

from __future__ import annotations

import errno
import mmap
import os
import subprocess
import sys
import weakref
from pathlib import Path

import pytest

from stages.base import atomic
from stages.base.atomic import partial_prefix, remove_abandoned_files, replacing
from stages.base.errors import ResourceError


def ended() -> str:
    """The prefix of a process that has ended."""
    code = "from stages.base.atomic import partial_prefix; print(partial_prefix())"
    command = [sys.executable, "-c", code]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


def test_on_windows_a_rename_that_is_refused_is_tried_again_and_maps_are_closed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    refused: list[Path] = []
    real = os.replace

    def replace(source: Path, target: Path) -> None:
        if len(refused) < 2:
            refused.append(source)
            raise PermissionError(13, "used by another process")
        real(source, target)

    monkeypatch.setattr(os, "replace", replace)
    monkeypatch.setattr(atomic, "_WAITS_S", (0.0, 0.0))
    (tmp_path / "a").write_text("new")
    with pytest.raises(PermissionError):
        atomic.rename(tmp_path / "a", tmp_path / "b")
    monkeypatch.setattr(atomic, "_WINDOWS", True)
    refused.clear()
    cycle: list[object] = [mmap.mmap(-1, 10)]
    cycle.append(cycle)
    held = weakref.ref(cycle[0])
    del cycle
    atomic.rename(tmp_path / "a", tmp_path / "b")
    assert (tmp_path / "b").read_text() == "new"
    assert held() is None
    refused[:] = []
    (tmp_path / "a").write_text("newer")
    monkeypatch.setattr(atomic, "_WAITS_S", (0.0,))
    with pytest.raises(PermissionError):
        atomic.rename(tmp_path / "a", tmp_path / "b")


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


def test_a_file_that_is_too_large_for_its_place_is_no_matter_of_permissions(tmp_path: Path) -> None:
    with pytest.raises(ResourceError) as error, replacing(tmp_path / "a"):
        raise OSError(errno.EFBIG, os.strerror(errno.EFBIG))
    assert error.value.code == "file-not-written"
    assert "FAT32" in error.value.wanted
    assert "permissions" not in error.value.hint


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EIO])
def test_errors_name_the_folder_that_stays(tmp_path: Path, number: int) -> None:
    inner = tmp_path / f"{partial_prefix()}a" / "scene" / f"{partial_prefix()}b"
    inner.mkdir(parents=True)
    with pytest.raises(ResourceError) as error, replacing(inner / "scene.ply"):
        raise OSError(number, os.strerror(number))
    assert str(tmp_path) in error.value.given
    assert ".partial-" not in error.value.given
    assert "scene.ply" in error.value.given
