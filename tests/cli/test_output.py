"""Whatever standard output is, commands work and say what they mean."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest

from stages import formats
from tests import processes
from tests.scenes import splats


def run(words: list[str], **more: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(words, capture_output=True, text=True, **more)  # type: ignore[call-overload]


@pytest.mark.parametrize("encoding", ["ascii", "cp1252"])
def test_characters_that_the_output_lacks_are_escaped(tmp_path: Path, encoding: str) -> None:
    """As of a pipe on Windows."""
    path = tmp_path / "日本.ply"
    formats.write(path, splats([[0.0, 0.0, 0.0]]))
    found = run(
        processes.splat("info", str(path)), env={**os.environ, "PYTHONIOENCODING": encoding}
    )
    assert found.returncode == 0, found.stderr
    assert "\\u65e5\\u672c.ply" in found.stdout


@pytest.mark.skipif(os.name == "nt", reason="closes a file descriptor as POSIX does")
def test_a_closed_output_loses_what_is_printed_and_nothing_else(tmp_path: Path) -> None:
    formats.write(tmp_path / "a.ply", splats([[0.0, 0.0, 0.0]]))
    words = processes.splat("convert", str(tmp_path / "a.ply"), str(tmp_path / "b.ply"))
    found = run(words, preexec_fn=lambda: os.close(1))
    assert found.returncode == 0, found.stderr
    assert len(formats.read(tmp_path / "b.ply")) == 1


@pytest.mark.skipif(not Path("/proc").exists(), reason="no folder here that root cannot write to")
def test_completion_that_cannot_be_installed_names_the_file() -> None:
    words = processes.splat("--install-completion", "bash")
    found = run(words, env={**os.environ, "HOME": "/proc"})
    assert found.returncode == 6
    assert "completion-not-installed" in found.stderr
    assert "/proc/" in found.stderr
    assert "splat --show-completion" in found.stderr
