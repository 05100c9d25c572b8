"""Incomplete files of processes that ended are removed."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from stages.base.atomic import partial_prefix, remove_abandoned_files


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
