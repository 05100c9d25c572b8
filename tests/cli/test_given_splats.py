"""--splats on the command line: what is refused before any work, and how many steps are made."""

from __future__ import annotations

from pathlib import Path

import pytest

from splatcli import run_settings
from stages import formats
from stages.run.pipeline import Pipeline
from tests.scenes import splats as some_splats


@pytest.fixture
def given(tmp_path: Path) -> Path:
    path = tmp_path / "point_cloud.ply"
    formats.write(path, some_splats([[0, 0, 1], [0, 1, 2]]))
    return path


def test_given_splats_are_not_trained_unless_steps_are_asked_for(given: Path) -> None:
    assert run_settings.of_new_run({"splats": given})["train"].steps == 0
    found = run_settings.of_new_run({"splats": given, "steps": 500, "preset": "preview"})
    assert found["train"].steps == 500
    assert found["seed"].splats == found["train"].splats == given


def test_what_no_run_could_use_is_refused_before_photographs_are_read(splat, given: Path) -> None:
    for file, code in ((given, "seed-splats-without-cameras"), ("none.ply", "splats-unreadable")):
        result = splat("process", "photos", "--splats", str(file))
        assert result.exit_code != 0
        assert code in result.stderr
        assert not Path("run").exists()


def test_one_stage_alone_does_not_take_given_splats(splat, given: Path) -> None:
    assert splat("process", "photos").exit_code == 0
    for stage in ("seed", "train"):
        result = splat(stage, "run", "--splats", str(given))
        assert result.exit_code == 2
        assert "splat process run --splats" in result.stderr


def test_a_run_is_no_start_for_itself(splat) -> None:
    assert splat("process", "photos").exit_code == 0
    result = splat("process", "photos", "--splats", "run")
    assert result.exit_code == 2
    assert "--out NEW" in result.stderr


def test_a_run_goes_on_from_the_splats_of_another(splat) -> None:
    assert splat("process", "photos").exit_code == 0
    result = splat("process", "run", "--out", "second", "--splats", "run", "--steps", "9")
    assert result.exit_code == 0, result.stderr
    found = Pipeline(Path("second")).recorded_settings()
    assert found["train"].steps == 9
    trained = Path("run/4-train/splats.bin").absolute()
    assert found["seed"].splats == found["train"].splats == trained


def test_an_unfinished_run_is_no_start(splat) -> None:
    assert splat("ingest", "photos", "--out", "early").exit_code == 0
    result = splat("process", "photos", "--out", "second", "--splats", "early")
    assert result.exit_code == 2
    assert "stage-not-finished" in result.stderr


def test_a_preset_keeps_the_given_splats(given: Path) -> None:
    base = run_settings.of_new_run({"splats": given})
    assert run_settings.combined(base, {}, "best")["train"].splats == given
