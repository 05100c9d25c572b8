"""What a person types, and what comes back: words and exit status."""

from __future__ import annotations

import errno
import json
import os
import shutil
import sys
import time
import warnings
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from splatcli import api, console
from splatcli.app import ENTRIES, app
from splatcli.arguments import AS_JSON
from stages.base.distribution import NAME, VERSION
from stages.base.errors import Interrupted, SplatError
from stages.raster.gpu import device as gpu
from stages.run import results
from stages.run.lock import locked
from stages.run.pipeline import Pipeline
from tests.cameras.drawn import nerfstudio as drawn_transforms
from tests.cameras.models import example
from tests.processes import ROOT

STAGES = ("ingest", "sfm", "seed", "train", "prune", "quantise", "export")


def events(result) -> list[dict]:
    return [json.loads(line) for line in result.stdout.splitlines()]


def states(splat, *words: str) -> dict[str, str]:
    (event,) = events(splat("status", "--json", *words))
    return {row["stage"]: row["state"] for row in event["stages"]}


def reasons(splat) -> dict[str, str]:
    (event,) = events(splat("status", "--json"))
    return {row["stage"]: row["reason"] for row in event["stages"]}


def started(result) -> list[str]:
    return [e["stage"] for e in events(result) if e["event"] == "started"]


def test_process_writes_every_asset_and_prints_the_paths(splat) -> None:
    result = splat("process", "photos")
    assert result.exit_code == 0, result.output
    assert str(Path("run/7-export/out.ply")) in result.stdout
    assert "peak memory" in result.stdout
    assert "mean 27.12 dB" in " ".join(result.stdout.split())
    assert "Do it yourself" in result.stderr


def test_a_second_capture_beside_run_gets_a_folder_of_its_own_name(splat, tmp_path) -> None:
    other = tmp_path / "oak chair"
    other.mkdir()
    (other / "b.jpg").write_bytes(b"another photograph")
    first = splat("process", "photos")
    assert str(Path("run/7-export/out.ply")) in first.stdout
    second = splat("process", "oak chair")
    assert second.exit_code == 0, second.output
    assert str(Path("run-oak chair/7-export/out.ply")) in second.stdout
    assert "run holds a run of other photographs" in second.stderr
    again = splat("process", "oak chair", "--json")
    assert (again.exit_code, started(again)) == (0, [])
    assert started(splat("process", "photos", "--json")) == []
    assert splat("process", "nope").exit_code == 3
    assert splat("process", "oak chair", "--out", "run").exit_code == 5


def test_warnings_are_repeated_at_the_end(splat) -> None:
    splat("process", "photos")
    result = splat("process", "photos")  # nothing runs
    assert "7 warnings, of all stages:" in result.stderr
    assert "Do it yourself" in result.stderr
    assert "warnings" not in splat("process", "photos", "--quiet").stderr


def test_asset_paths_are_not_broken_on_a_narrow_terminal(splat, monkeypatch) -> None:
    monkeypatch.setattr(console.out, "_width", 40)  # undone by None, unlike the property
    long = "a folder with a name that is longer than any terminal is wide/run"
    result = splat("process", "photos", "--out", long)
    assert str(Path(long) / "7-export" / "out.ply") in result.stdout


def test_process_twice_does_nothing(splat) -> None:
    splat("process", "photos")
    result = splat("process", "photos", "--json")
    assert started(result) == []
    assert [e["stage"] for e in events(result) if e["event"] == "skipped"] == list(STAGES)


@pytest.mark.parametrize("again", ["export", "process", "python"])
def test_exporting_one_more_format_keeps_those_that_are_there(splat, again: str) -> None:
    splat("process", "photos", "--format", "ply")
    if again == "python":
        with suppress(Exception):  # the pretended outputs cannot be loaded
            api.process(Path("photos"), Path("run"), formats=("glb",))
    else:
        splat(*(again, "run", "--format", "glb"))
    manifest = json.loads(Path("run/7-export/manifest.json").read_text())
    assert manifest["settings"]["formats"] == ["ply", "glb"]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no such device here")
@pytest.mark.parametrize(
    "words", ["status run", "status run --json", "status --help", "--version", "nope --json"]
)
def test_output_that_cannot_be_written_is_one_error(splat, monkeypatch, capsys, words: str) -> None:
    splat("process", "photos")
    with Path("/dev/full").open("w") as full, monkeypatch.context() as patch:
        patch.setattr(sys, "stdout", full)
        with pytest.raises(SystemExit) as end:
            app(words.split())
    assert end.value.code == (2 if words.startswith("nope") else 6)
    printed = capsys.readouterr().err
    assert ("command-line" if words.startswith("nope") else "output-not-written") in printed


def test_code_of_photographs_that_are_not_there_is_the_documented_one(splat) -> None:
    result = splat("process", "nope")
    text = (ROOT / "docs" / "guide" / "troubleshooting.md").read_text(encoding="utf-8")
    row = next(row for row in text.splitlines() if row.startswith("| `photographs-missing`"))
    assert "photographs-missing" in result.stderr
    assert "at the path given" in row


def test_of_photographs_that_are_not_there_nothing_is_said_of_the_run_that_is(splat) -> None:
    splat("process", "photos")
    assert splat("process", "nope").stderr.startswith("Error: ")


def test_every_command_has_json_and_says_that_outputs_were_verified(splat) -> None:
    assert all(AS_JSON in entry.added for entry in ENTRIES.values())
    splat("process", "photos")
    assert [e["event"] for e in events(splat("status", "--verify", "--json"))] == [
        *("status", "verified")
    ]


def test_newest_splats_are_made_from_what_lies_there(splat) -> None:
    splat("process", "photos")
    run = Pipeline(Path("run"))
    assert results.newest_stage_with_splats(run) == "quantise"
    splat("prune", "run", "--max-splats", "107000")
    assert results.newest_stage_with_splats(run) == "prune"
    assert results.out_of_date(run) == {"quantise": "prune", "export": "prune"}
    splat("sfm", "run", "--max-features", "1000")
    with pytest.raises(SplatError, match="from its present sfm") as error:
        results.newest_stage_with_splats(run)
    assert error.value.code == "no-splats-yet"


def test_warnings_of_libraries_are_in_the_log_and_not_on_the_terminal(splat, pretend) -> None:
    def warning(inputs, settings, folder, report) -> None:
        np.float32(1e30) * np.float32(1e30)  # RuntimeWarning: overflow
        (folder / "out.ply").write_text("made")

    pretend["train"] = warning
    with warnings.catch_warnings(record=True) as printed:
        warnings.simplefilter("always")
        splat("process", "photos")
        assert not printed
        result = splat("train", "run", "--steps", "9", "--verbose")
    log = Path(result.stderr.split("Log: ")[1].splitlines()[0])
    assert "RuntimeWarning: overflow" in log.read_text()
    log.unlink()


def test_verbose_writes_what_a_bug_report_needs(splat, pretend) -> None:
    result = splat("process", "photos", "--verbose", "--steps", "123")
    assert result.exit_code == 0
    log = Path(result.stderr.split("Log: ")[1].splitlines()[0])
    text = log.read_text()
    log.unlink()
    for part in (f"{NAME} {VERSION}", "platform: ", "cores", "free memory: ", "numpy ", "torch "):
        assert part in text
    assert "settings of train: {'steps': 123" in text
    assert "warning pretend-careful: Nothing was really done." in text
    assert "train: finished in" in text


def test_the_log_holds_the_traceback_of_an_error_that_is_explained(splat, pretend) -> None:
    def run(inputs, settings, folder, report) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    pretend["seed"] = run
    result = splat("process", "photos", "--verbose", "--json")
    assert result.exit_code == 6
    log = Path(events(result)[0]["path"])
    text = log.read_text()
    log.unlink()
    assert "Traceback (most recent call last)" in text
    assert "OSError: [Errno 28] No space left on device" in text


def test_quiet_prints_only_paths_and_warnings(splat) -> None:
    result = splat("process", "photos", "--quiet")
    assert result.stdout == f"{Path('run/7-export/out.ply')}\n"
    said = result.stderr.splitlines()
    assert len(said) == len(STAGES)  # each pretends to have warned
    assert all(line.startswith("Warning") for line in said)


def test_json_is_lines_of_json_ending_in_the_result(splat, pretend) -> None:
    def take_its_time(inputs, settings, folder, report) -> None:
        time.sleep(0.05)
        (folder / "out.ply").write_text("twelve bytes")

    pretend["train"] = take_its_time
    begun = time.monotonic()
    last = events(splat("process", "photos", "--json", "--out", "elsewhere"))[-1]
    assert last["event"] == "result"
    assert last["run_folder"] == "elsewhere"
    assert set(last["stages"]) == set(STAGES)
    assert 0.05 <= last["stages"]["train"]["seconds"] <= time.monotonic() - begun
    assert last["assets"] == [{"path": str(Path("elsewhere/7-export/out.ply")), "size_bytes": 12}]


def test_changed_steps_are_named_by_status(splat, pretend) -> None:
    splat("process", "photos", "--steps", "700")

    def stop(inputs, settings, folder, report) -> None:
        raise Interrupted

    pretend["train"] = stop
    assert splat("train", "--steps", "900").exit_code == 130
    assert reasons(splat)["train"] == "steps 700 -> 900"
    assert reasons(splat)["prune"] == "train runs again first"
    assert "steps 700 -> 900" in splat("status").stdout


def test_stop_says_how_to_go_on_and_exits_130(splat, pretend, monkeypatch) -> None:
    def stop(inputs, settings, folder, report) -> None:
        raise Interrupted

    pretend["sfm"] = stop
    monkeypatch.setattr("sys.argv", ["splat", "process", "my photos"])
    result = splat("process", "photos")
    assert result.exit_code == 130
    assert "splat process 'my photos'" in result.stderr
    assert states(splat)["ingest"] == "finished"
    assert states(splat)["sfm"] == "interrupted"
    del pretend["sfm"]
    assert splat("process").exit_code == 0  # with nothing named: what was asked before


def test_status_names_the_process_that_holds_the_lock(splat, pretend) -> None:
    def stop(inputs, settings, folder, report) -> None:
        raise Interrupted

    pretend["sfm"] = stop
    splat("process", "photos")
    assert states(splat)["sfm"] == "interrupted"
    with locked(Path("run")):
        assert states(splat)["sfm"] == "running"
        assert f"Process {os.getpid()}" in splat("status").stdout
        assert splat("process", "photos").exit_code == 5


def test_preset_gives_the_training_settings(splat) -> None:
    from stages.train.settings import PRESETS

    splat("process", "photos", "--preset", "preview")
    assert repr(PRESETS["preview"]) == Path("run/4-train/out.ply").read_text()
    splat("train", "--preset", "best", "--steps", "77")
    text = Path("run/4-train/out.ply").read_text()
    assert "steps=77" in text


def test_seed_reaches_every_stage_that_has_one(splat) -> None:
    splat("process", "photos", "--seed", "5")
    seeds = {}
    for folder in Path("run").glob("[1-7]-*"):
        seeds[folder.name] = json.loads((folder / "manifest.json").read_text())["seed"]
    assert seeds["2-sfm"] == seeds["4-train"] == 5
    assert set(seeds.values()) <= {5, None}


def test_format_is_repeatable(splat) -> None:
    result = splat("process", "photos", "--format", "ply", "--format", "usdz")
    assert result.exit_code == 0, result.output
    assert "('ply', 'usdz')" in Path("run/7-export/out.ply").read_text()


def test_stages_run_one_by_one(splat) -> None:
    assert splat("ingest", "photos", "--out", "run").exit_code == 0
    for name in STAGES[1:]:
        assert splat(name).exit_code == 0, name
    assert set(states(splat).values()) == {"finished"}


def test_export_before_train_names_the_command_to_run(splat) -> None:
    splat("ingest", "photos")
    result = splat("export", "--format", "gltf")
    assert result.exit_code == 2
    assert "splat sfm" in result.stderr
    assert states(splat)["ingest"] == "finished"


def test_export_after_train_runs_the_cheap_stages_between(splat) -> None:
    for name in ("ingest", "sfm", "seed", "train"):
        splat(name, *(["photos"] if name == "ingest" else []))
    result = splat("export", "--format", "gltf", "--json")
    assert result.exit_code == 0, result.output
    assert started(result) == ["prune", "quantise", "export"]


def test_run_folder_is_found_from_inside_beside_and_alone(splat, tmp_path, monkeypatch) -> None:
    splat("process", "photos", "--out", "only")
    assert splat("status").exit_code == 0
    monkeypatch.chdir(tmp_path / "only")
    assert splat("status").exit_code == 0
    monkeypatch.chdir(tmp_path)
    splat("process", "photos", "--out", "second")
    unclear = splat("status")
    assert unclear.exit_code == 2
    assert "only, second" in unclear.stderr
    splat("process", "photos")  # run/ is the default among several
    assert splat("status").exit_code == 0


def test_run_folder_in_which_nothing_succeeded_is_not_offered(splat, pretend) -> None:
    def refuse(inputs, settings, folder, report) -> None:
        raise SplatError("ingest-x", given="Two cats.", wanted="A dog.", hint="Bark.")

    pretend["ingest"] = refuse
    splat("process", "photos", "--out", "empty")
    assert splat("status").exit_code == 0  # the only one: it has something to tell
    assert states(splat, "empty")["ingest"] == "failed"
    assert "Two cats. (ingest-x)" in " ".join(splat("status", "empty").stdout.split())
    del pretend["ingest"]
    splat("process", "photos", "--out", "good")
    assert states(splat)["ingest"] == "finished"
    pretend["ingest"] = refuse
    splat("process", "photos")  # nor is it where it is called run/
    assert states(splat)["ingest"] == "finished"


def test_a_missing_run_folder_is_reported_with_the_first_command(splat) -> None:
    result = splat("train")
    assert result.exit_code == 5
    assert "splat process PHOTOS" in result.stderr


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["process", "photos", "--steps", "-4"], "--steps -4 cannot be used"),
        (["process", "photos", "--steps", "many"], "A whole number from 0 to 1,000,000."),
        (["process", "photos", "--preset", "fast"], "One of preview, standard, best."),
        (["process", "photos", "--backend", "cuda"], "One of auto, gpu, webgpu, cpu, reference."),
        (["process", "photos", "--format", "obj"], "--format obj cannot be used"),
        (["process", "photos", "--stepz", "4"], "splat process: No such option: --stepz"),
        (["process", "photos", "--steps"], "--steps"),
        (["process", "photos", "--train-side", "nan"], "--train-side nan cannot be used"),
        (["export", "--name", "a/b"], "--name a/b cannot be used"),
        (["proces", "photos"], "No such command 'proces'"),
        (["process", "photos", "more"], "(more)"),
        (["process", "photos", "--split"], "--split means nothing without --cameras."),
        (["convert", "a.ply"], "splat convert: Missing"),
        (["render", "--width", "0"], "A whole number from 1 to 16,384."),
        (["view", "--port", "x"], "--port x cannot be used"),
    ],
)
def test_command_line_errors_have_our_form_and_exit_2(splat, words: list[str], said: str) -> None:
    result = splat(*words)
    assert result.exit_code == 2, result.output
    assert said in result.stderr
    for label in ("Error: ", "Wanted: ", "Next: "):
        assert label in result.stderr
    for foreign in ("Traceback", "Value error", "Input should", "Invalid value", "Usage:"):
        assert foreign not in result.output
    assert not Path("run").exists()


def test_an_unavailable_backend_is_reported_before_other_work(splat, monkeypatch) -> None:
    monkeypatch.delenv("TRITON_INTERPRET", raising=False)
    monkeypatch.setattr(gpu, "missing", lambda: "no card")
    result = splat("process", "photos", "--backend", "gpu")
    assert result.exit_code == 6, result.output
    assert "The backend gpu cannot run here" in result.stderr
    assert not Path("run").exists()


def test_cameras_that_cannot_be_read_are_refused_before_anything_is_made(splat) -> None:
    Path("cameras.json").write_text("{")
    for name, code in (("nothing", "cameras-unknown"), ("cameras.json", "cameras-unreadable")):
        result = splat("process", "photos", "--cameras", name)
        assert code in result.stderr
        assert not Path("run").exists()


def test_cameras_that_are_gone_after_their_stage_count_as_unchanged(splat) -> None:
    example().write(Path("sparse/0"))
    assert splat("process", "photos", "--cameras", "sparse/0").exit_code == 0
    next(Path("sparse/0").glob("images.*")).unlink()
    assert states(splat)["sfm"] == "finished"


def test_cameras_that_were_damaged_after_their_stage_are_a_reason_to_run_again(splat) -> None:
    path = drawn_transforms(Path())
    assert splat("process", "photos", "--cameras", str(path)).exit_code == 0
    path.write_text("{")
    assert f"cameras file {path.name} changed" in reasons(splat)["sfm"]
    assert "cameras-unreadable" not in splat("status").stderr


def test_a_split_that_the_camera_file_has_not_is_refused_before_anything_is_made(splat) -> None:
    example().write(Path("sparse/0"))
    result = splat("process", "photos", "--cameras", "sparse/0", "--split")
    assert "cameras-without-split" in result.stderr
    assert result.exit_code == 2
    assert not Path("run").exists()


def test_command_line_errors_are_json_with_json(splat) -> None:
    for words in (["--steps", "-1"], ["--stepz", "0"]):
        (event,) = events(splat("process", "photos", "--json", *words))
        assert (event["event"], event["family"]) == ("error", 2)


def test_training_that_goes_on_says_which_settings_it_keeps(splat) -> None:
    fresh = splat("process", "photos", "--preset", "preview")
    assert "Training:" not in fresh.stderr
    again = splat("train", "--steps", "7000")
    assert (
        "Training: steps 7,000 (as given); steps per view 150, train side 480, SH degree 1, "
        "max splats 60,000 (as recorded in the run)." in again.stderr
    )
    other = splat("process", "--preset", "standard").stderr
    assert "Training: steps per view 150, train side 800, SH degree 2, max splats 250," in other


def test_naming_the_photographs_again_keeps_earlier_options(splat) -> None:
    splat("ingest", "photos", "--max-side", "100")
    splat("process", "photos", "--preset", "best")
    again = splat("process", "photos", "--json", "--format", "spz")
    assert started(again) == ["quantise", "export"]


def test_an_empty_value_takes_an_option_with_a_file_back(splat) -> None:
    Path("m").mkdir()
    splat("process", "photos", "--masks", "m")
    again = splat("process", "photos", "--masks", "", "--json")
    assert started(again)[0] == "ingest"
    assert "masks" in events(again)[0]["reason"]
    assert started(splat("process", "--json")) == []


def test_a_lost_run_file_means_the_default_preset(splat) -> None:
    splat("ingest", "photos")
    Path("run/run.json").unlink()
    assert "max splats 250,000" in splat("process", "photos").stderr


def test_folders_that_may_not_be_read_hide_no_run_folder(splat, monkeypatch) -> None:
    splat("process", "photos", "--out", "mine")
    Path("locked").mkdir()
    is_file = Path.is_file

    def refuse(path: Path) -> bool:
        if path.parent.name == "locked":
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        return is_file(path)

    monkeypatch.setattr(Path, "is_file", refuse)
    assert splat("status").exit_code == 0


def test_every_splat_error_shows_given_wanted_next_and_code(splat, pretend) -> None:
    def refuse(inputs, settings, folder, report) -> None:
        raise SplatError("ingest-x", given="Two cats.", wanted="A dog.", hint="Bark [loudly].")

    pretend["ingest"] = refuse
    result = splat("process", "photos")
    assert result.exit_code == 3
    for words in ("Two cats.", "A dog.", "Bark [loudly].", "ingest-x"):
        assert words in result.stderr
    last = events(splat("process", "photos", "--json"))[-1]
    assert last == {
        "event": "error",
        "code": "ingest-x",
        "given": "Two cats.",
        "wanted": "A dog.",
        "hint": "Bark [loudly].",
        "family": 3,
    }


def test_full_disk_exits_6_and_keeps_what_is_finished(splat, pretend) -> None:
    def full(inputs, settings, folder, report) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    pretend["train"] = full
    result = splat("process", "photos")
    assert result.exit_code == 6
    assert "Free some space" in result.stderr
    assert states(splat)["seed"] == "finished"


def test_bug_is_called_a_bug_and_its_traceback_is_in_a_file(splat, pretend) -> None:
    def broken(inputs, settings, folder, report) -> None:
        raise ZeroDivisionError("division by zero")

    pretend["seed"] = broken
    result = splat("process", "photos")
    assert result.exit_code == 1
    assert "This is a bug" in result.stderr
    assert "Traceback" not in result.stderr
    log = Path(result.stderr.split("report it with ")[1].strip())
    assert "ZeroDivisionError" in log.read_text()
    log.unlink()


def test_debug_shows_the_traceback(splat, pretend, monkeypatch) -> None:
    def broken(inputs, settings, folder, report) -> None:
        raise ZeroDivisionError

    pretend["seed"] = broken
    monkeypatch.setenv("SPLAT_DEBUG", "1")
    assert isinstance(splat("process", "photos").exception, ZeroDivisionError)


def test_render_refuses_what_is_not_a_picture_or_a_run(splat) -> None:
    assert splat("render", "nowhere.ply").exit_code == 3
    assert splat("render", "--out", "x.ply").exit_code == 2
    splat("ingest", "photos")
    early = splat("render")
    assert early.exit_code == 2
    assert "splat process" in early.stderr


def test_a_run_folder_and_another_out_make_a_second_run_that_begins_as_the_first(splat) -> None:
    splat("process", "photos", "--steps", "70")
    second = splat("process", "run", "--out", "other", "--steps", "80", "--json")
    assert started(second)[0] == "train"
    again = splat("process", "run", "--out", "other", "--steps", "80", "--json")
    assert again.exit_code == 0
    assert started(again) == []
    assert started(splat("process", "run", "--json")) == []


def test_runs_of_different_photographs_do_not_go_on_from_each_other(splat) -> None:
    splat("process", "photos")
    shutil.copytree("photos", "photos2")
    splat("process", "photos2", "--out", "other")
    result = splat("process", "run", "--out", "other")
    assert result.exit_code == 2
    assert "--out" in result.stderr


def test_a_run_folder_without_its_run_file_is_continued_by_the_same_command(splat) -> None:
    command = ("process", "photos", "--out", "hill", "--steps", "70")
    assert splat(*command).exit_code == 0
    Path("hill/run.json").unlink()
    assert splat("status", "hill").exit_code == 0
    assert started(splat(*command, "--json")) == []


def test_names_reach_the_terminal_without_control_characters(splat, pretend) -> None:
    def refuse(inputs, settings, folder, report) -> None:
        report.progress(1, 2, "reading \x1b[2J.jpg")
        report.warn("pretend-name", "bad\udcff\x1b[31m.jpg is left out.")

    pretend["ingest"] = refuse
    os.rename("photos", os.fsencode("new\nline\x1b[31m\udcff"))
    shown = splat("process", "new\nline\x1b[31m\udcff", "--out", "run\x1b[31m")
    assert shown.exit_code == 0
    assert "\x1b" not in shown.output
    assert r"bad\xff\x1b[31m.jpg is left out." in shown.output
    words = ("process", "no\nfolder\x1b[31m\udcff")
    assert r"no\nfolder\x1b[31m\xff does not exist." in splat(*words).stderr
    assert "\x1b" not in splat(*words, "--json").output


@pytest.mark.parametrize(
    ("refused", "shown"), [("bad\udcff.usdc", r"bad\xff.usdc has"), ("<p>\udcff" * 9999, "has")]
)
def test_name_that_a_library_cannot_use_is_an_error_in_words(
    splat, pretend, refused: str, shown: str
) -> None:
    def refuse(inputs, settings, folder, report) -> None:
        refused.encode()

    pretend["export"] = refuse
    result = splat("process", "photos")
    assert result.exit_code == 3
    assert f"{shown} a name that is not UTF-8" in result.stderr
    assert "<p>" not in result.stderr
