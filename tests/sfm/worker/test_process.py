"""The worker process: every kind of end is reported, and it never outlives the parent."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from threading import Event, Timer

import numpy as np
import pytest

from stages.base.errors import Interrupted, SplatError
from stages.sfm.worker import process
from stages.sfm.worker.job import Job, KnownCameras, Learned, Neighbours, Triangulation
from tests import processes
from tests.sfm.worker.jobs import job


@dataclass(frozen=True)
class Nonsense(Job):
    """A step that the worker does not know."""

    step = "nonsense"


def pretend(monkeypatch: pytest.MonkeyPatch, code: str) -> None:
    """Let the worker be a Python program."""
    monkeypatch.setattr(process, "_command", lambda path: [sys.executable, "-c", code])


def run(tmp_path: Path, stop: Event | None = None, max_seconds: float = 30.0) -> int:
    ticks: list[int] = []
    process.run_worker(
        job(tmp_path), tmp_path, stop or Event(), max_seconds, lambda: ticks.append(1)
    )
    return len(ticks)


def test_a_job_survives_being_written(tmp_path: Path) -> None:
    project, file = job(tmp_path).project, tmp_path / "job.json"
    assert Job.read(job(tmp_path).write(file)) == job(tmp_path)
    learned = Learned(project, tmp_path / "b.db", (0, 2))
    assert Job.read(learned.write(file)) == learned


def test_known_cameras_survive_being_written_exactly(tmp_path: Path) -> None:
    project, file = job(tmp_path).project, tmp_path / "job.json"
    random = np.random.default_rng(0)
    cameras = KnownCameras(random.random((1, 4)), random.random((1, 4, 4)))
    triangulation = Triangulation(project, tmp_path / "out", cameras, refine=True)
    read = Job.read(triangulation.write(file))
    assert isinstance(read, Triangulation)
    assert (read.project, read.out, read.refine) == (project, tmp_path / "out", True)
    for name, values in vars(cameras).items():
        np.testing.assert_array_equal(getattr(read.cameras, name), values)
    neighbours = Job.read(Neighbours(project, cameras, ((0, 1),)).write(file))
    np.testing.assert_array_equal(neighbours.cameras.intrinsics, cameras.intrinsics)


def test_success_ticks_at_least_at_the_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pretend(monkeypatch, "pass")
    assert run(tmp_path) >= 1


def test_an_abort_is_reported_with_its_last_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pretend(monkeypatch, "import os; print('Check failed: x > 0', flush=True); os.abort()")
    with pytest.raises(process.WorkerCrashed) as crash:
        run(tmp_path)
    error = crash.value
    assert error.code == "sfm-crashed"
    assert "signal 6 (SIGABRT) during features" in error.given
    assert "Check failed: x > 0" in error.given
    assert str(tmp_path / "log.txt") in error.hint
    assert "Check failed" in (tmp_path / "log.txt").read_text()


def test_the_last_line_is_not_the_progress_of_other_threads(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """COLMAP's other threads, and other processes, go on telling how far they are."""
    told = "I20261121 22:16:11.982047 140047659562688 pairing.cc:938] Processing block [1/1]"
    code = f"import os; print('Check failed: x > 0'); print({told!r}, flush=True); os.abort()"
    pretend(monkeypatch, code)
    with pytest.raises(process.WorkerCrashed) as crash:
        run(tmp_path)
    assert crash.value.given.endswith("Check failed: x > 0")


def test_a_full_disk_is_recognised(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pretend(monkeypatch, "print('SQLite error: database or disk is full'); raise SystemExit(3)")
    with pytest.raises(SplatError) as error:
        run(tmp_path)
    assert error.value.code == "disk-full"


def test_stopping_and_time_limits_end_the_worker_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pretend(monkeypatch, "import time; time.sleep(60)")
    started = time.monotonic()
    with pytest.raises(process.WorkerTimedOut):
        run(tmp_path, max_seconds=0.3)
    stop = Event()
    Timer(0.3, stop.set).start()
    with pytest.raises(Interrupted):
        run(tmp_path, stop=stop)
    assert time.monotonic() - started < 10


def test_photographs_beside_a_module_of_the_same_name_do_no_harm(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("numpy.py", "stages.py", "json.py"):
        (tmp_path / name).write_text("raise SystemExit('shadowed')")
    monkeypatch.chdir(tmp_path)
    unknown = Nonsense(job(tmp_path).project)
    with pytest.raises(process.WorkerCrashed) as crash:
        process.run_worker(unknown, tmp_path, Event(), 30.0, lambda: None)
    log = (tmp_path / "log.txt").read_text()
    assert "nonsense" in crash.value.given
    assert "shadowed" not in log


def test_the_worker_ends_when_its_input_does(tmp_path: Path) -> None:
    """The portable half of dying with the parent, while COLMAP is busy."""
    code = (
        "import time; from stages.base.parent import die_with_parent; die_with_parent();"
        "print('ready', flush=True); time.sleep(60)"
    )
    worker = subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    assert worker.stdin is not None
    assert worker.stdout is not None
    assert worker.stdout.readline() == b"ready\n"
    worker.stdin.close()
    assert worker.wait(timeout=10) == 1


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_kill_minus_nine_of_the_parent_ends_the_worker(tmp_path: Path) -> None:
    sleeper = (
        "from stages.base.parent import die_with_parent; die_with_parent();"
        "import time, os; print(os.getpid(), flush=True); time.sleep(60)"
    )
    parent_code = f"""
import sys, threading
from pathlib import Path
from stages.sfm.worker import process
from tests.sfm.worker.jobs import job
process._command = lambda path: [sys.executable, "-c", {sleeper!r}]
folder = Path({str(tmp_path)!r})
process.run_worker(job(folder), folder, threading.Event(), 60.0, lambda: None)
"""
    log = tmp_path / "log.txt"
    with processes.running(processes.python(parent_code)) as parent:
        deadline = time.monotonic() + 60
        while not (log.exists() and log.read_text().endswith("\n")):
            assert time.monotonic() < deadline
            assert parent.poll() is None
            time.sleep(0.05)
        pid = int(log.read_text())
        parent.send_signal(signal.SIGKILL)
        parent.wait(timeout=20)
    deadline = time.monotonic() + 10
    while _alive(pid) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not _alive(pid)


def _alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
        return "State:\tZ" not in Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return False
