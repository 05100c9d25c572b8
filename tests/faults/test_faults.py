"""A sample of `python -m tests.faults`: killed stages and full disks end in the same bytes."""

from __future__ import annotations

import subprocess
import sys

import pytest

from tests import processes


@pytest.mark.slow
@pytest.mark.timeout(300)
@pytest.mark.skipif(sys.platform != "linux", reason="forks, and mounts file systems")
def test_killed_stages_and_full_disks_end_in_the_same_bytes() -> None:
    """Twenty kills and a full disk in all stages but structure from motion, whose trials last
    longer than all others together; tests/test_kill_resume.py kills that one."""
    stages = ("ingest", "seed", "train", "prune", "quantise", "export")
    done = subprocess.run(
        processes.module("tests.faults", "--kills", "20", "--disks", "1", *stages),
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    assert done.stdout.count("|\n") == len(stages)
