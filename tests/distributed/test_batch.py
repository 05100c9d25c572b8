"""Many captures: one table, one worst status, and nothing done twice."""

from __future__ import annotations

import csv
import errno
import importlib.metadata
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from threading import Event

import pytest

from splatcli import run_settings
from stages.base.errors import Interrupted, SplatError
from stages.distributed import cluster
from stages.distributed.remote import capture_name
from stages.distributed.tasks import Resources, RunTask, SerialExecutor
from stages.run.listener import Listener
from stages.run.lock import locked
from stages.run.pipeline import Pipeline
from tests.cli.pretence import failing_at

NAMES = ("hill", "room", "well")


@pytest.fixture
def captures(splat, tmp_path) -> list[str]:
    for name in NAMES:
        (tmp_path / "captures" / name).mkdir(parents=True)
        (tmp_path / "captures" / name / "a.jpg").write_text(name)
    return [f"captures/{name}" for name in NAMES]


def rows() -> dict[str, dict[str, str]]:
    with Path("runs/batch.csv").open(encoding="utf-8") as file:
        return {row["capture"]: row for row in csv.DictReader(file)}


def manifests() -> dict[str, int]:
    return {str(p): p.stat().st_mtime_ns for p in Path("runs").glob("*/*/manifest.json")}


def test_each_capture_has_a_run_folder_and_a_row(splat, captures) -> None:
    result = splat("batch", *captures, "--steps", "12")
    assert result.exit_code == 0, result.output
    assert {name: row["status"] for name, row in rows().items()} == dict.fromkeys(NAMES, "done")
    assert all(row["warnings"] == "pretend-careful" for row in rows().values())
    made = json.loads(Path("runs/room/4-train/manifest.json").read_text())
    assert made["settings"]["steps"] == 12
    assert str(Path("runs") / "batch.csv") in result.stdout


def test_what_is_finished_is_not_done_again(splat, captures) -> None:
    splat("batch", *captures[:2])
    before = manifests()
    assert splat("batch", *captures).exit_code == 0
    assert {path: manifests()[path] for path in before} == before
    assert set(rows()) == set(NAMES)


def test_formats_that_were_exported_stay(splat, captures) -> None:
    splat("batch", captures[0], "--format", "splat")
    assert splat("batch", captures[0], "--format", "ply").exit_code == 0
    made = json.loads(Path("runs/hill/7-export/manifest.json").read_text())
    assert set(made["settings"]["formats"]) == {"splat", "ply"}


def test_options_that_are_not_given_again_stay(splat, captures) -> None:
    splat("batch", captures[0], "--steps", "12", "--format", "ply")
    trained = Path("runs/hill/4-train/manifest.json").read_bytes()
    assert splat("batch", *captures[:2], "--format", "glb").exit_code == 0
    assert Path("runs/hill/4-train/manifest.json").read_bytes() == trained
    recorded = {n: run_settings.recorded(Pipeline(Path("runs") / n)) for n in NAMES[:2]}
    assert recorded["hill"]["train"].steps == 12
    assert recorded["room"]["train"].steps == 0
    assert set(recorded["hill"]["export"].formats) == {"ply", "glb"}


def test_a_run_with_damaged_settings_does_not_keep_the_others(splat, captures) -> None:
    splat("batch", captures[0])
    Path("runs/hill/run.json").write_text("{}")
    assert splat("batch", *captures[:2]).exit_code != 0
    assert {name: row["status"] for name, row in rows().items()} == {
        "hill": "manifest-edited",
        "room": "done",
    }


def test_rows_of_other_captures_and_earlier_figures_stay(splat, captures, pretend) -> None:
    splat("batch", *captures[:2])
    before = rows()
    stopped = Interrupted("stopped")
    pretend["ingest"] = failing_at("well", stopped)
    splat("batch", captures[2], captures[1])
    assert rows()["hill"] == before["hill"]
    assert rows()["room"] == {**before["room"], "status": "waiting"}
    assert rows()["well"]["status"] == "waiting"


def test_a_damaged_table_is_made_again(splat, captures) -> None:
    Path("runs").mkdir()
    Path("runs/batch.csv").write_bytes(b"\xff\x00capture,other\n1,2,3\n")
    assert splat("batch", captures[0]).exit_code == 0
    assert rows()["hill"]["status"] == "done"


def test_the_folder_above_is_named_by_its_name(splat, captures, monkeypatch) -> None:
    monkeypatch.chdir(captures[0])
    assert capture_name(Path("..")) == "captures"
    assert capture_name(Path("../..") / "..") == Path.cwd().parents[2].name
    assert capture_name(Path()) == "hill"


def test_a_stop_that_is_given_reaches_each_run(tmp_path: Path) -> None:
    """Otherwise it would take signals, which only a main thread may."""
    seen: list[Event | None] = []

    class Recording(RunTask):
        def run(self, listener: Listener | None = None, stop: Event | None = None) -> None:
            seen.append(stop)

    stop = Event()
    list(SerialExecutor().results([Recording(tmp_path)] * 2, Resources(None), stop))
    assert seen == [stop, stop]


def test_a_capture_that_fails_does_not_keep_the_others(splat, captures, pretend) -> None:
    blurred = SplatError("ingest-blurred", given="All blurred.", wanted="Sharp.", hint="Again.")
    pretend["ingest"] = failing_at("room", blurred)
    result = splat("batch", *captures)
    assert result.exit_code == 3
    assert {name: row["status"] for name, row in rows().items()} == {
        "hill": "done",
        "room": "ingest-blurred",
        "well": "done",
    }
    assert "room: All blurred. (ingest-blurred)" in result.stderr


def test_the_worst_status_is_the_batch_s(splat, captures, pretend) -> None:
    pretend["ingest"] = failing_at("hill", OSError(errno.ENOSPC, "No space left on device"))
    result = splat("batch", *captures, "missing")
    assert result.exit_code == 6
    assert rows()["hill"]["status"] == "disk-full"
    assert rows()["missing"]["status"] == "photographs-missing"
    assert rows()["well"]["status"] == "done"


def test_a_bug_in_one_capture_is_its_own(splat, captures, pretend) -> None:
    pretend["ingest"] = failing_at("hill", RuntimeError("unheard of"))
    result = splat("batch", *captures, "--json")
    assert result.exit_code == 1
    ended = [json.loads(line) for line in result.stdout.splitlines()]
    assert ended[0]["message"] == "RuntimeError: unheard of."
    assert [e["status"] for e in ended if e["event"] == "ended"] == ["bug", "done", "done"]


def test_runs_among_photographs_are_refused_before_anything_is_written(splat, captures) -> None:
    result = splat("batch", *captures, "--out", f"{captures[1]}/runs")
    assert result.exit_code == 2
    assert "run-folder-inside-photographs" in result.stderr
    assert [path.name for path in Path(captures[1]).iterdir()] == ["a.jpg"]


def test_two_captures_of_one_name_are_refused(splat, captures, tmp_path) -> None:
    (tmp_path / "other" / "Room").mkdir(parents=True)
    result = splat("batch", *captures, "other/Room")
    assert result.exit_code == 2
    assert "batch-same-name" in result.stderr
    assert not Path("runs").exists()


def test_two_batches_in_one_folder_are_refused(splat, captures) -> None:
    Path("runs").mkdir()
    with locked(Path("runs")):
        result = splat("batch", *captures)
    assert result.exit_code == 5
    assert "run-folder-busy" in result.stderr


def test_without_ray_a_cluster_is_refused_and_nothing_else(splat, captures, monkeypatch) -> None:
    real = importlib.import_module

    def without_ray(name: str, package: str | None = None):
        if name == "ray":
            raise ImportError(name)
        return real(name, package)

    monkeypatch.setattr(importlib, "import_module", without_ray)
    result = splat("batch", *captures, "--cluster", "local:2")
    assert result.exit_code == 2
    assert 'pip install "splatcli[cluster]"' in result.stderr
    assert splat("batch", *captures).exit_code == 0


def test_nothing_imports_ray_unless_a_cluster_is_asked_for() -> None:
    code = (
        "import sys\n"
        "import splatcli.app, splatcli.commands.batch\n"
        "import stages.distributed.cluster, stages.distributed.tasks\n"
        "print('ray' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


def answer(**changes) -> cluster.Worker:
    return replace(cluster.Worker("b7", "2", (), 4, 9000.0), **changes)


def test_a_worker_with_another_splat_is_refused_and_both_are_named(tmp_path) -> None:
    with pytest.raises(SplatError, match="b7 has splat 1; here it is splat 2") as found:
        cluster.check([answer(), answer(edition="1")], "2", tmp_path / "t")
    assert found.value.code == "cluster-other-splat"


def test_a_folder_that_a_worker_does_not_see_is_named(tmp_path) -> None:
    token = tmp_path / "runs" / ".seen"
    with pytest.raises(SplatError, match=r"b7 does not see .*runs\.") as found:
        cluster.check([answer(unseen=(str(token),))], "2", token)
    assert found.value.code == "cluster-folder-unseen"
    with pytest.raises(SplatError, match="does not see /photos/x"):
        cluster.check([answer(unseen=("/photos/x",))], "2", token)


@pytest.mark.parametrize(
    ("tasks", "workers", "memory_mib", "wanted"),
    [
        (100, [answer(), answer()], 3000.0, (1, 3000.0)),
        (2, [answer(), answer(cpus=8, memory_mib=500.0)], 400.0, (4, 400.0)),
        (1, [answer()], None, (4, 9000.0)),
    ],
)
def test_tasks_share_the_processors_and_take_the_memory_they_need(
    tasks, workers, memory_mib, wanted
) -> None:
    found = cluster.RayExecutor(None, tuple(workers))
    assert found.allocation(tasks, Resources(memory_mib)) == wanted


def test_a_run_that_no_worker_has_the_memory_for_is_refused() -> None:
    """Ray would wait for such a worker for ever."""
    with pytest.raises(SplatError, match=r"21\.0 GB, and no worker has more than 9\.4 GB"):
        cluster.RayExecutor(None, (answer(),)).allocation(1, Resources(20_000.0))
