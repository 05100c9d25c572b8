"""`splat tradeoff` and `splat compare`: what is printed, and runs that cannot be measured."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stages.base.stage import Report, Stage
from stages.evaluate.evaluation import EvaluationView
from stages.run import pipeline
from stages.run.stages import STAGES
from stages.scene.storage import save_splats
from tests.small_scene import small_scene

Splat = Callable[..., Any]


@pytest.fixture
def views() -> dict[str, int]:
    """How many photographs the next run has; more than four hold one out."""
    return {"count": 10}


@pytest.fixture
def splat(splat: Splat, monkeypatch: pytest.MonkeyPatch, views: dict[str, int]) -> Splat:
    """Runs of a little scene: its cameras and photographs stand there, training to export are real
    but short. `splat("process", ...)` ends after seconds."""

    def sfm(inputs: Any, settings: Any, folder: Path, report: Report) -> None:
        small_scene(folder, views["count"])

    def load_sfm(folder: Path) -> Any:
        return replace(small_scene(folder, views["count"]).reconstruction, origin=np.zeros(3))

    def seed(inputs: Any, settings: Any, folder: Path, report: Report) -> Any:
        scene = small_scene(folder, views["count"]).splats.with_sh_degree(0)
        save_splats(folder, scene)
        return scene

    def shortened(real: Stage) -> Stage:
        if real.name == "ingest":
            return replace(real, run=lambda *_: None, load=lambda folder: None)
        if real.name == "sfm":
            return replace(real, run=sfm, load=load_sfm)
        return replace(real, run=seed) if real.name == "seed" else real

    monkeypatch.setattr(pipeline, "STAGES", tuple(map(shortened, STAGES)))
    return splat


SHORT = ("--steps", "40", "--train-side", "72", "--max-splats", "300")


def made(splat: Splat, run: str, *more: str) -> None:
    result = splat("process", "photos", "--out", run, *SHORT, "--format", "ply", *more)
    assert result.exit_code == 0, result.output


def failed(result: Any) -> str:
    assert result.exit_code not in (0, 1), result.output
    return str(json.loads(result.stdout.splitlines()[-1])["code"])


@pytest.mark.slow
def test_the_trade_off_is_printed_and_its_report_is_in_the_run_folder(splat: Splat) -> None:
    made(splat, "run")
    result = splat("tradeoff", "run")
    assert result.exit_code == 0, result.output
    assert Path("run/tradeoff/report.html").is_file()
    assert str(Path("run/tradeoff/report.html")) in result.stdout
    assert "CPU" in result.stdout  # the log of training has times
    assert "splat prune --max-splats" in result.stdout
    status = json.loads(splat("status", "run", "--json").stdout)
    assert {row["state"] for row in status["stages"]} == {"finished"}


def test_a_run_without_held_out_photographs_is_reported(splat: Splat, views) -> None:
    views["count"] = 3
    made(splat, "run")
    assert failed(splat("tradeoff", "run", "--json")) == "nothing-held-out"


def test_held_out_photographs_of_which_masks_leave_nothing_are_reported(
    splat: Splat, monkeypatch: pytest.MonkeyPatch
) -> None:
    made(splat, "run")
    monkeypatch.setattr(EvaluationView, "counts", False)
    result = splat("tradeoff", "run", "--json")
    assert failed(result) == "nothing-held-out"
    assert "Masks leave nothing" in result.stdout


def test_an_unfinished_run_is_reported(splat: Splat) -> None:
    assert splat("ingest", "photos", "--out", "run").exit_code == 0
    assert failed(splat("tradeoff", "run", "--json")) == "stage-not-finished"
    assert failed(splat("compare", "run", "run", "--json")) == "stage-not-finished"
    assert failed(splat("tradeoff", "nowhere", "--json")) == "run-folder-missing"


def test_a_run_whose_stages_do_not_belong_together_is_reported(splat: Splat) -> None:
    made(splat, "run")
    assert splat("train", "run", "--steps", "30").exit_code == 0
    assert failed(splat("tradeoff", "run", "--json")) == "run-half-anew"
    assert failed(splat("compare", "run", "run", "--json")) == "run-half-anew"
    assert "Run `splat process run` to finish it" in splat("compare", "run", "run").stderr


@pytest.mark.slow
def test_commands_take_the_newest_splats_that_are_made_from_what_lies_there(splat: Splat) -> None:
    made(splat, "run")
    assert json.loads(splat("info", "run", "--json").stdout)["splats_from"] == "quantise"
    assert splat("train", "run", "--steps", "30").exit_code == 0
    shown = splat("info", "run", "--json")
    facts = json.loads(shown.stdout)
    assert facts["splats_from"] == "train"
    assert facts["out_of_date"] == ["prune", "quantise", "export"]
    assert "train ran again since prune, quantise, export did" in shown.stderr
    shown = splat("edit", "run", "--dry-run", "--keep", "opacity > 0.1")
    assert "These are the splats of train" in shown.stderr


def test_a_run_compared_with_itself_has_no_significant_difference(splat: Splat) -> None:
    made(splat, "run")
    result = splat("compare", "run", "run", "--json")
    reported = json.loads(result.stdout)
    assert reported["verdict"] == "no significant difference"
    assert reported["psnr_change_db"] == 0
    assert Path("comparison/report.html").is_file()


@pytest.mark.slow
def test_runs_of_other_photographs_are_not_compared(splat: Splat) -> None:
    made(splat, "one")
    Path("photos/a.jpg").write_text("b")
    made(splat, "two")
    assert failed(splat("compare", "one", "two", "--json")) == "compare-other-photographs"


@pytest.mark.slow
def test_two_runs_are_named_by_their_folders(splat: Splat) -> None:
    made(splat, "one")
    made(splat, "two", "--seed", "3")
    result = splat("compare", "one", "two")
    assert result.exit_code == 0, result.output
    assert "two against one:" in result.stdout
