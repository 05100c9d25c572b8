"""Captures and runs at URLs: as in folders, and half a stage is never taken for a whole."""

from __future__ import annotations

import csv
import hashlib
import io
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import Any

import pytest

from stages.base.errors import SplatError
from stages.base.stage import Report
from stages.distributed import remote
from stages.run.request import REQUEST
from stages.run.runfile import RUN_FILE
from stages.run.stages import STAGE_OF
from stages.train import cap, hooks
from stages.train import stage as train
from stages.train.settings import TrainSettings
from tests import processes, sample
from tests.cli.pretence import failing_at
from tests.small_scene import small_scene

fsspec = pytest.importorskip("fsspec", reason='pip install "splatcli[cluster]" brings it')

NAMES = ("hill", "room")


@pytest.fixture
def store(splat) -> Iterator[Any]:
    """memory://captures/hill and /room; nothing is left of it."""
    system = fsspec.filesystem("memory")
    system.store.clear()
    system.pseudo_dirs[:] = [""]
    for name in NAMES:
        system.pipe(f"/captures/{name}/a.jpg", name.encode())
    yield system
    system.store.clear()
    system.pseudo_dirs[:] = [""]


def rows(store: Any) -> dict[str, dict[str, str]]:
    table = io.StringIO(store.cat("/runs/batch.csv").decode())
    return {row["capture"]: row for row in csv.DictReader(table)}


def batch(splat, *more: str):
    return splat("batch", "memory://captures/*", "--out", "memory://runs", *more)


def test_captures_and_runs_at_urls(splat, store) -> None:
    result = batch(splat, "--steps", "12")
    assert result.exit_code == 0, result.output
    assert {name: row["status"] for name, row in rows(store).items()} == dict.fromkeys(
        NAMES, "done"
    )
    assert all(row["warnings"] == "pretend-careful" for row in rows(store).values())
    made = json.loads(store.cat("/runs/room/4-train/manifest.json"))
    assert made["settings"]["steps"] == 12
    assert "memory://runs/batch.csv" in result.stdout


def test_what_is_finished_at_a_url_is_not_done_again(splat, store, pretend) -> None:
    batch(splat)
    before = {path: store.modified(path) for path in store.find("/runs/hill") if "-" in path}
    pretend["ingest"] = failing_at("hill", RuntimeError("done again"))
    assert batch(splat).exit_code == 0
    assert {path: store.modified(path) for path in before} == before


def test_options_and_rows_of_an_earlier_call_stay(splat, store) -> None:
    batch(splat, "--steps", "12")
    trained = store.cat("/runs/hill/4-train/manifest.json")
    result = splat("batch", "memory://captures/hill", "--out", "memory://runs", "--format", "glb")
    assert result.exit_code == 0, result.output
    assert store.cat("/runs/hill/4-train/manifest.json") == trained
    assert set(rows(store)) == set(NAMES)


def test_a_stage_of_which_half_is_there_is_done_again(splat, store) -> None:
    batch(splat)
    store.rm_file("/runs/hill/5-prune/manifest.json")
    store.pipe("/runs/hill/5-prune/stray.bin", b"half")
    assert batch(splat).exit_code == 0
    assert sorted(path.rpartition("/")[2] for path in store.find("/runs/hill/5-prune")) == [
        "manifest.json",
        "out.ply",
    ]


def test_a_manifest_comes_last_and_goes_first(splat, store, monkeypatch) -> None:
    order: list[str] = []
    real_put, real_rm = store.put_file, store.rm_file

    def put_file(here: str, there: str) -> None:
        order.append(there)
        real_put(here, there)

    def rm_file(path: str) -> None:
        order.append(f"no {path}")
        real_rm(path)

    monkeypatch.setattr(store, "put_file", put_file)
    monkeypatch.setattr(store, "rm_file", rm_file)
    batch(splat)
    batch(splat, "--steps", "9")
    own = [name.replace("/runs/hill/4-train/", "") for name in order if "hill/4-train" in name]
    assert own[:3] == ["out.ply", "manifest.json", "no manifest.json"]
    assert own[-2:] == ["out.ply", "manifest.json"]


def test_each_checkpoint_is_uploaded_once_and_its_request_only_once(store, tmp_path) -> None:
    partial = tmp_path / ".4-train.partial"
    put: list[str] = []
    partial.mkdir()
    run = remote.RemoteFolder.at("memory://runs/hill")
    (tmp_path / RUN_FILE).write_text("{}")
    back = remote.UploadListener(tmp_path, run)
    system_put = store.put_file

    def putting(source: str, target: str) -> None:
        put.append(target)
        system_put(source, target)

    store.put_file = putting
    try:
        for name in (REQUEST, "cap.json", "usage.json"):
            (partial / name).write_text(name)
        back.started(STAGE_OF["train"], 4, "", False)
        for steps in (1, 2, 3):
            (partial / "checkpoint.bin").write_text(f"after {steps}")
            os.utime(partial / "checkpoint.bin", ns=(steps, steps))
            for _ in range(3):
                back.progressed(STAGE_OF["train"], "training", steps, 9, {})
    finally:
        del store.put_file
    assert [PurePosixPath(path).name for path in put] == [
        RUN_FILE,
        REQUEST,
        *3 * ("cap.json", "usage.json", "checkpoint.bin"),
    ]
    there = "/runs/hill/.4-train.partial"
    assert store.cat(f"{there}/checkpoint.bin") == b"after 3"
    assert store.cat(f"{there}/usage.json") == b"usage.json"


class LostError(Exception):
    """A worker is lost."""


@pytest.mark.timeout(300)  # the first to train compiles kernels
def test_a_run_at_a_url_goes_on_under_its_first_cap_on_a_worker_with_less_memory(
    tmp_path, monkeypatch
) -> None:
    scene = small_scene(tmp_path)
    inputs = {"sfm": scene.reconstruction, "seed": scene.splats.with_sh_degree(0)}
    settings = TrainSettings(steps=30, train_side=48, sh_degree=0, max_splats=0)
    monkeypatch.setattr(cap, "splat_cap", int)
    monkeypatch.setattr(hooks, "CHECKPOINT_SECONDS", 0.0)
    stage = STAGE_OF["train"]

    def trained(name: str, free_mib: float, last: int = 30) -> tuple[bytes, dict[str, Any]]:
        monkeypatch.setattr(cap, "available_mib", lambda: free_mib)
        report = Report()
        with remote.local_copies((tmp_path / name).as_uri(), None) as (run_folder, _, upload):
            folder = run_folder / ".4-train.partial"
            resumed = folder.exists()
            folder.mkdir(parents=True, exist_ok=True)
            for file in (run_folder / RUN_FILE, folder / REQUEST):
                file.write_text("{}")
            upload.started(stage, 4, "", resumed)

            def progressed(label: str, done: int, total: int, numbers: Any) -> None:
                upload.progressed(stage, label, done, total, numbers)
                if label == "training" and done == last < total:
                    raise LostError

            report.listener = progressed
            train.run(inputs, settings, folder, report)
            return (folder / "splats.bin").read_bytes(), report.metrics

    whole, figures = trained("whole", 200.0)
    assert (figures["splat_cap"], figures["splat_cap_from"]) == (200, "free memory")
    with pytest.raises(LostError):
        trained("lost", 200.0, last=12)
    again, resumed = trained("lost", 100.0)
    assert (resumed["resumed_from_step"], resumed["splat_cap"]) == (12, 200)
    assert again == whole


def test_what_fails_at_a_url_is_said_of_the_url(splat, store, pretend) -> None:
    def run(inputs, settings, folder, report) -> None:
        if inputs["photos"].name == "room":
            raise SplatError(
                "ingest-blurred", given=f"{inputs['photos']}: bad.", wanted="", hint=""
            )
        (folder / "out.ply").write_text("made")

    pretend["ingest"] = run
    result = batch(splat)
    assert result.exit_code == 3
    assert "room: memory:///captures/room: bad. (ingest-blurred)" in result.stderr
    assert {name: row["status"] for name, row in rows(store).items()} == {
        "hill": "done",
        "room": "ingest-blurred",
    }


def test_a_folder_here_and_a_url_go_together(splat, store, tmp_path) -> None:
    result = splat("batch", "photos", "memory://captures/hill", "--out", "memory://runs")
    assert result.exit_code == 0, result.output
    assert set(rows(store)) == {"photos", "hill"}
    assert splat("batch", "memory://captures/*", "--out", "here").exit_code == 0
    assert (tmp_path / "here" / "room" / "7-export" / "manifest.json").is_file()


def documented_status(code: str) -> int:
    """The exit status that the table of codes has in brackets."""
    text = (processes.ROOT / "docs" / "guide" / "troubleshooting.md").read_text(encoding="utf-8")
    row = next(line for line in text.splitlines() if line.startswith(f"| `{code}` |"))
    return int(row.split("(")[1].split(")")[0])


@pytest.mark.parametrize(
    "words", [("process", "photos", "--out"), ("process",), ("convert", "a.ply")]
)
def test_a_url_where_a_path_is_wanted_is_refused(splat, store, words: tuple[str, ...]) -> None:
    result = splat(*words, "s3://bucket/run")
    assert result.exit_code == documented_status("url-not-local")
    assert "s3://bucket/run is a URL" in result.stderr
    assert not Path("s3:").exists()


@pytest.mark.parametrize(
    ("url", "code"),
    [
        ("memory://captures/nothing*", "url-not-found"),
        ("nosuch://captures/hill", "url-unknown"),
        ("s3://captures/hill", "url-not-installed"),
        ("file:///proc/1/root/captures/*", "url-not-found"),
    ],
)
def test_a_url_that_cannot_be_used_is_said_before_anything_starts(splat, store, url, code) -> None:
    if code == "url-not-installed" and "s3fs" in sys.modules:
        pytest.skip("s3fs is installed")
    result = splat("batch", url, "--out", "runs")
    assert result.exit_code == documented_status(code)
    assert code in result.stderr
    assert not Path("runs").exists()


def test_a_capture_that_is_not_there_does_not_keep_the_others(splat, store) -> None:
    urls = ("memory://captures/hill", "memory://captures/gone")
    result = splat("batch", *urls, "--out", "memory://runs")
    assert result.exit_code == 3
    assert {name: row["status"] for name, row in rows(store).items()} == {
        "hill": "done",
        "gone": "url-not-found",
    }


@pytest.mark.parametrize(
    "reason", [PermissionError("no"), RuntimeError("Unable to locate credentials")]
)
def test_rights_that_are_missing_are_told(splat, store, monkeypatch, reason: Exception) -> None:
    """The second is what s3fs raises where none are set."""

    def refused(*_: object, **__: object) -> None:
        raise reason

    monkeypatch.setattr(store, "put_file", refused)
    result = batch(splat)
    assert result.exit_code == documented_status("url-not-permitted")
    assert "url-not-permitted" in result.stderr


def test_nothing_imports_fsspec_without_a_url() -> None:
    code = "import sys, splatcli.app, splatcli.commands.batch; print('fsspec' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


def test_names_that_lead_out_of_a_folder_are_left_alone(store) -> None:
    store.store["/captures/hill/../../evil.jpg"] = store.store["/captures/hill/a.jpg"]
    assert remote.RemoteFolder.at("memory://captures/hill").names() == ["a.jpg"]


def hashes(runs: Path) -> dict[str, str]:
    return {
        path.relative_to(runs).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(runs.glob("*/[1-7]-*/**/*"))
        if path.is_file() and path.name != "manifest.json"
    }


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_urls_give_the_same_bytes_as_folders(tmp_path: Path) -> None:
    (tmp_path / "captures" / "front").mkdir(parents=True)
    for photo in sorted(sample.PHOTOS.iterdir())[:8]:
        shutil.copy(photo, tmp_path / "captures" / "front")
    small = (
        *("--preset", "preview", "--train-side", "96", "--steps", "60", "--max-splats", "1500"),
        *("--finetune-steps", "0", "--format", "ply"),
    )
    url = tmp_path.as_uri()
    for words in (
        ("captures/front", "--out", "here"),
        (f"{url}/captures/*", "--out", f"{url}/far"),
    ):
        command = processes.splat("batch", *words, *small)
        subprocess.run(command, cwd=tmp_path, check=True, timeout=400)
    assert hashes(tmp_path / "far") == hashes(tmp_path / "here") != {}
