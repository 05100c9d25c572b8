"""The command with its real options, over stages that only pretend to work."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from typer.testing import CliRunner

from splatcli import console
from splatcli.app import app
from stages.base.stage import Stage
from stages.run import pipeline
from stages.run.stages import STAGES

Splat = Callable[..., Any]


def _pretend(inputs: Any, settings: Any, folder: Path, report: Any) -> None:
    report.progress(1, 2, "pretending", splats=1200, psnr_db=27.123)
    report.warn("pretend-careful", "Nothing was really done. Do it yourself.")
    report.metric("psnr_db", 27.123)
    (folder / "out.ply").write_text(repr(settings))


def _load(folder: Path) -> Any:
    file = SimpleNamespace(format="ply", path="out.ply", size_bytes=12)
    return SimpleNamespace(folder=folder, files=(file,))


@pytest.fixture(autouse=True)
def _width_of_each_test(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rich keeps the COLUMNS that were set when the module was imported, in whichever test."""
    for screen in (console.out, console.err):
        monkeypatch.setattr(screen, "_width", None)


@pytest.fixture
def pretend(monkeypatch: pytest.MonkeyPatch) -> dict[str, Callable[..., Any]]:
    """Replaces what stages do; an entry under a stage's name replaces that one's `run`."""
    runs: dict[str, Callable[..., Any]] = {}

    def pretending(real: Stage) -> Stage:
        def run(*given: Any) -> Any:
            return runs.get(real.name, _pretend)(*given)

        return dataclasses.replace(real, run=run, load=_load)

    monkeypatch.setattr(pipeline, "STAGES", tuple(map(pretending, STAGES)))
    return runs


@pytest.fixture
def splat(
    pretend: dict[str, Callable[..., Any]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Splat:
    """splat("status", "--json") in a folder of its own that holds photos/."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "a.jpg").write_text("a")
    runner = CliRunner()

    def call(*words: str) -> Any:
        return runner.invoke(app, list(words))

    return call
