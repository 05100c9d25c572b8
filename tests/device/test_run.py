"""What a part of a run costs the others where it fails, hangs or is killed: nothing."""

from __future__ import annotations

import json
import os
import subprocess
import time
from pathlib import Path

import pytest

from tests import processes
from tests.device import run
from tests.device.parts import RUNS, SECONDS, Part

HANGS = "import time; print('began', flush=True); time.sleep(60)"
KEEPS = (
    "import sys; sys.path.append({root!r})\n"
    "from pathlib import Path; from tests.device.results import Results\n"
    "Results(Path(sys.argv[1])).row('found', '42', '43'); {then}"
)


def part(name: str, code: str, limit_s: float = 30.0, **how) -> Part:
    return Part(name, limit_s, ("-c", code, "RESULT"), toy=(), **how)


def keeps(then: str) -> str:
    return KEEPS.format(root=str(processes.ROOT), then=then)


def made(tmp_path: Path, parts: list[Part], seconds: float = 60.0) -> dict:
    work, out = tmp_path / "work", tmp_path / "out"
    work.mkdir()
    out.mkdir()
    ends = time.monotonic() + seconds
    run.Run(out, work, tmp_path, True, ends, dict(os.environ)).make(parts)
    assert (out / "table.txt").exists()
    return json.loads((out / "results.json").read_text())


def test_a_part_that_hangs_is_killed_and_keeps_what_it_found(tmp_path, monkeypatch):
    monkeypatch.setattr(run, "TOY_PATIENCE", 1.0)
    parts = [
        part("hangs", keeps(HANGS), 4.0, group="together"),
        part("fails", keeps("1 / 0"), group="together"),
        part("good", keeps("")),
    ]
    found = made(tmp_path, parts)
    assert found["hangs"]["ended"] == "killed at its limit"
    assert found["fails"]["ended"] == "exit status 1"
    assert found["good"]["ended"] == "done"
    assert all(found[name]["table"] == [["found", "42", "43"]] for name in found)
    log = (tmp_path / "out" / "log.txt").read_text()
    assert "began" in log
    assert "ZeroDivisionError" in log
    assert "42   [43]" in (tmp_path / "out" / "table.txt").read_text()


def test_what_goes_on_behind_is_waited_for_by_who_needs_it(tmp_path):
    after = "import time; time.sleep(0.5); open({0!r}, 'w').write('')"
    mark = str(tmp_path / "mark")
    parts = [
        part("behind", after.format(mark), behind=True),
        part("beside", "import os; print(os.getpid())"),
        part("needs", f"open({mark!r})", needs="behind"),
        part("never", HANGS, behind=True),
    ]
    found = made(tmp_path, parts)
    assert [found[name]["ended"] for name in ("behind", "beside", "needs")] == ["done"] * 3
    assert found["never"]["ended"] != "done"


def test_what_there_is_no_time_for_is_not_started(tmp_path):
    found = made(tmp_path, [part("late", "print(1)")], seconds=1.0)
    assert found["late"]["ended"] == "not started: no time left"


def test_every_part_names_a_module_that_is_there():
    for number, parts in RUNS.items():
        assert SECONDS[number] <= 590
        for each in parts:
            module = each.words[1]
            path = processes.ROOT.joinpath(*module.split(".")).with_suffix(".py")
            assert module == "pytest" or path.exists(), module


@pytest.mark.slow
def test_a_toy_run_leaves_whole_results(tmp_path):
    pytest.importorskip("triton")
    words = ("tests.device.run", "1", "--toy", "--out", str(tmp_path), "--part", "memcheck")
    done = subprocess.run(processes.module(*words), capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    found = json.loads((tmp_path / "results.json").read_text())
    assert found["memcheck"]["ended"] == "done"
    assert "finite: True" in done.stdout
