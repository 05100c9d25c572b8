"""The Python API refuses what it does not know before it does anything; test_docs_run runs it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path
from threading import Event
from typing import Any, get_type_hints

import numpy as np
import pytest
from PIL import Image

import splatcli
from splatcli import Interrupted, SplatError, open_run, process, run_settings
from splatcli.api import Options
from stages.base.settings import settings_of
from stages.run.pipeline import Pipeline
from stages.run.stages import STAGES
from stages.train.settings import PRESETS, TrainSettings
from tests import scenes
from tests.processes import ROOT


def test_unknown_option_is_refused(tmp_path: Path) -> None:
    with pytest.raises(TypeError, match="no stage has the option colour"):
        process(tmp_path, tmp_path / "run", colour="red")  # type: ignore[call-arg]
    assert not (tmp_path / "run").exists()


def test_unknown_preset_is_refused_with_those_that_exist(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="preview, standard, best"):
        process(tmp_path, tmp_path / "run", preset="quick")


def test_value_out_of_range_is_the_error_of_the_command(tmp_path: Path) -> None:
    with pytest.raises(SplatError, match="--train-side 3") as caught:
        process(tmp_path, tmp_path / "run", train_side=3)
    assert caught.value.code == "option-value"
    assert not (tmp_path / "run").exists()


def test_the_typed_options_are_the_fields_of_the_stages_settings() -> None:
    fields = {
        one.name: get_type_hints(s.settings_type)[one.name]
        for s in STAGES
        for one in settings_of(s.settings_type)
    }
    assert get_type_hints(Options) == fields


@pytest.mark.slow
def test_a_type_checker_refuses_an_option_that_does_not_exist(tmp_path: Path) -> None:
    call = "from splatcli import process\nprocess('photos', 'run', {}=3)\n"
    for option, wrong in (("steps", False), ("stepz", True)):
        (tmp_path / "own.py").write_text(call.format(option))
        done = subprocess.run(
            [sys.executable, "-m", "mypy", "--strict", "--config-file=", "own.py"],
            cwd=tmp_path,
            env=os.environ | {"MYPYPATH": str(ROOT)},
            capture_output=True,
            text=True,
            timeout=300,
        )
        assert (f'Unexpected keyword argument "{option}"' in done.stdout) == wrong, done.stdout


def test_importing_the_package_loads_nothing_and_names_what_it_has() -> None:
    code = "import sys, splatcli; print('numpy' in sys.modules, 'stages' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", "False"]
    with pytest.raises(AttributeError, match="no attribute 'proces'"):
        splatcli.proces  # noqa: B018


def photographs(folder: Path) -> Path:
    folder.mkdir()
    for number in range(4):
        picture = np.random.default_rng(number).integers(0, 255, (48, 64, 3), np.uint8)
        Image.fromarray(picture).save(folder / f"{number}.png")
    return folder


def test_a_run_is_cancelled_from_its_progress_and_signals_stay_as_they_are(tmp_path: Path) -> None:
    cancel, seen, handlers = Event(), [], set()

    def stop(progress: splatcli.Progress) -> None:
        seen.append(progress)
        handlers.add(signal.getsignal(signal.SIGINT))
        cancel.set()

    with pytest.raises(Interrupted):
        process(photographs(tmp_path / "p"), tmp_path / "run", progress=stop, cancel=cancel)
    assert {one.stage for one in seen} == {"ingest"}
    assert 0 <= seen[0].done <= seen[0].total
    assert handlers == {signal.getsignal(signal.SIGINT)}
    assert not (tmp_path / "run" / "2-sfm").exists()


def test_a_number_of_splats_that_is_given_holds_as_it_does_for_the_command(tmp_path: Path) -> None:
    """The limit of `standard` for each view does not lower it."""
    cancel = Event()
    cancel.set()
    with pytest.raises(Interrupted):
        process(photographs(tmp_path / "p"), tmp_path / "run", cancel=cancel, max_splats=400_000)
    train = Pipeline(tmp_path / "run").recorded_settings({"train": TrainSettings()})["train"]
    assert (train.max_splats, train.splats_per_view) == (400_000, 0)


def recorded(folder: Path) -> dict[str, Any]:
    return Pipeline(folder).recorded_settings(run_settings.defaults())


def begun(folder: Path, **options: Any) -> dict[str, Any]:
    """The settings that a run in `folder` records, which stops before its first stage."""
    photos, cancel = folder / "p", Event()
    cancel.set()
    with pytest.raises(Interrupted):
        process(
            photos if photos.exists() else photographs(photos),
            folder / "run",
            cancel=cancel,
            **options,
        )
    return recorded(folder / "run")


def test_options_that_are_not_given_keep_the_values_of_the_run(tmp_path: Path) -> None:
    first = begun(tmp_path, preset="preview", max_side=320)
    assert begun(tmp_path) == begun(tmp_path, preset="preview") == first
    assert (first["ingest"].max_side, first["train"]) == (320, PRESETS["preview"])
    assert begun(tmp_path, preset="best")["ingest"].max_side == 320


def test_paths_may_be_texts_and_are_taken_back_by_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert begun(tmp_path, masks="masks")["ingest"].masks == tmp_path / "masks"
    assert begun(tmp_path, masks=None)["ingest"].masks is None


def test_known_cameras_that_no_run_could_use_are_the_error_of_the_command(tmp_path: Path) -> None:
    (tmp_path / "cameras.json").write_text("{")
    with pytest.raises(SplatError) as caught:
        process(photographs(tmp_path / "p"), tmp_path / "run", cameras=tmp_path / "cameras.json")
    assert caught.value.code == "cameras-unreadable"
    assert not (tmp_path / "run").exists()


def test_a_folder_that_is_no_run_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SplatError) as caught:
        open_run(tmp_path)
    assert caught.value.code == "run-folder-missing"


def test_splats_are_taken_by_a_mask_and_told_in_one_line() -> None:
    splats = scenes.cloud(1234)
    mask = splats.means[:, 0] > 0
    np.testing.assert_array_equal(splats[mask].means, splats.means[mask])
    assert len(splats[:10]) == 10
    assert repr(splats) == f"Splats(1,234, SH degree {splats.sh_degree})"
