"""Peak memory of a stretch of work, children included."""

from __future__ import annotations

import subprocess
import sys

import pytest

from stages.base.memory import PeakMemory, available_mib, resident_mib

exact = pytest.mark.skipif(sys.platform != "linux", reason="sampled where it cannot be reset")
HOLD_MIB = 120


@exact
def test_peak_counts_memory_given_back_before_the_end() -> None:
    before = resident_mib()
    with PeakMemory() as memory:
        held = b"x" * (HOLD_MIB * 2**20)
        del held
    assert memory.peak_mib > before + 0.9 * HOLD_MIB


_TWO_STRETCHES = f"""
from stages.base.memory import PeakMemory
with PeakMemory() as first:
    held = b"x" * ({HOLD_MIB} * 2**20)
    del held
with PeakMemory() as second:
    pass
print(first.peak_mib, second.peak_mib)
"""


@exact
def test_peak_of_one_stretch_is_not_inherited_by_the_next() -> None:
    """In a process of its own: what other tests in this one have freed comes and goes."""
    run = [sys.executable, "-c", _TWO_STRETCHES]
    done = subprocess.run(run, capture_output=True, text=True, check=True, timeout=60)
    first, second = map(float, done.stdout.split())
    assert second < first - 0.5 * HOLD_MIB


def test_peak_counts_child_processes() -> None:
    code = f"import time; x = b'x' * ({HOLD_MIB} * 2**20); time.sleep(0.6)"
    before = resident_mib()
    with PeakMemory(interval_s=0.02) as memory:
        subprocess.run([sys.executable, "-c", code], check=True, timeout=30)
    assert memory.peak_mib > before + 0.9 * HOLD_MIB


def test_free_memory_is_known_and_of_a_process_that_ended_there_is_none() -> None:
    assert available_mib() > 100
    with subprocess.Popen([sys.executable, "-c", ""]) as child:
        child.wait()
    assert resident_mib(child.pid) == 0.0
