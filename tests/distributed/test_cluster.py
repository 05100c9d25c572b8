"""`splat batch` on Ray: the same bytes as without it, whatever is killed on the way."""

from __future__ import annotations

import csv
import hashlib
import os
import random
import shutil
import signal
import subprocess
import time
from collections.abc import Sequence
from pathlib import Path

import pytest

from stages.base.memory import descendants
from tests import processes, sample

pytest.importorskip("ray", reason='no Ray: pip install "splatcli[cluster]" brings it')

pytestmark = [pytest.mark.cluster, pytest.mark.slow, pytest.mark.timeout(900)]

KILLS = int(os.environ.get("SPLAT_TEST_KILLS", "3"))
SEED = int(os.environ.get("SPLAT_TEST_SEED", "4"))
SMALL = (
    *("--preset", "preview", "--train-side", "128", "--steps", "200", "--max-splats", "3000"),
    *("--finetune-steps", "0", "--format", "ply"),
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """captures/ of ten photographs each, and what they give without Ray in alone/."""
    found = tmp_path_factory.mktemp("cluster")
    photos = sorted(sample.PHOTOS.iterdir())
    for name, chosen in (("front", photos[:10]), ("back", photos[12:22])):
        (found / "captures" / name).mkdir(parents=True)
        for photo in chosen:
            shutil.copy(photo, found / "captures" / name)
    subprocess.run(words("alone"), cwd=found, check=True, timeout=600)
    return found


def words(out: str, *more: str) -> list[str]:
    captures = ("captures/front", "captures/back")
    return processes.splat("batch", *captures, "--out", out, *SMALL, *more)


def outputs(runs: Path, which: str = "*/") -> dict[str, str]:
    """SHA-256 of each output file of each stage of each run."""
    return {
        path.relative_to(runs).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(runs.glob(f"{which}[1-7]-*/**/*"))
        if path.is_file() and path.name != "manifest.json"
    }


def ray_workers(driver: int) -> list[int]:
    """Process ids of the workers that do a task."""
    found = []
    for pid in descendants(driver):
        try:
            title = Path(f"/proc/{pid}/cmdline").read_bytes()
        except OSError:
            continue
        if title.startswith(b"ray::_with_threads"):
            found.append(pid)
    return found


def with_kills(folder: Path, command: Sequence[str], kills: int) -> int:
    """Run it, and kill a worker as many times at random moments; how many were."""
    chance, done = random.Random(SEED), 0
    with processes.running(command, cwd=folder) as process:
        while process.poll() is None:
            time.sleep(chance.uniform(0.5, 6.0))
            workers = ray_workers(process.pid)
            if workers and done < kills:
                os.kill(chance.choice(workers), signal.SIGKILL)
                done += 1
        assert process.returncode == 0
    return done


def blocks_of(folder: Path, name: str, *more: str, kills: int = 0) -> dict[str, str]:
    """Outputs of a capture in two blocks, from the cameras that were found before."""
    for done in sorted((folder / "alone" / "front").glob("[1-3]-*")):
        shutil.copytree(done, folder / name / done.name)
    shutil.copy(folder / "alone" / "front" / "run.json", folder / name)
    command = processes.splat(
        "process", "captures/front", "--out", name, "--blocks", "2", *SMALL, *more
    )
    assert with_kills(folder, command, kills) == kills
    return outputs(folder / name, "blocks/*/") | outputs(folder / name, "")


def test_workers_that_are_killed_change_nothing(folder: Path) -> None:
    killed = with_kills(folder, words("killed", "--cluster", "local:2"), KILLS)
    assert killed == KILLS
    assert outputs(folder / "killed") == outputs(folder / "alone")
    with (folder / "killed" / "batch.csv").open(encoding="utf-8") as file:
        assert [row["status"] for row in csv.DictReader(file)] == ["done", "done"]


def test_runs_at_urls_are_the_same_and_a_killed_worker_changes_nothing(folder: Path) -> None:
    url = folder.as_uri()
    command = processes.splat(
        *("batch", f"{url}/captures/*", "--out", f"{url}/far", *SMALL, "--cluster", "local:2")
    )
    assert with_kills(folder, command, 2) == 2
    assert outputs(folder / "far") == outputs(folder / "alone")


def test_a_head_that_is_killed_leaves_nobody_behind_and_is_gone_on_with(folder: Path) -> None:
    command = words("headless", "--cluster", "local:2")
    with processes.running(command, cwd=folder) as process:
        while not ray_workers(process.pid):
            time.sleep(0.2)
            assert process.poll() is None
        time.sleep(random.Random(SEED).uniform(2.0, 8.0))
        left = descendants(process.pid)
    ends = time.monotonic() + 30
    while any(Path(f"/proc/{pid}").exists() for pid in left) and time.monotonic() < ends:
        time.sleep(0.2)
    subprocess.run(command, cwd=folder, check=True, timeout=600)
    assert outputs(folder / "headless") == outputs(folder / "alone")


def test_blocks_are_the_same_whoever_trains_them(folder: Path) -> None:
    here = blocks_of(folder, "here")
    assert sum(name.startswith("blocks/") for name in here) > 10
    for workers in (1, 2, 4):
        address, kills = f"local:{workers}", int(workers == 2)
        found = blocks_of(folder, f"by-{workers}", "--cluster", address, kills=kills)
        assert found == here, workers
