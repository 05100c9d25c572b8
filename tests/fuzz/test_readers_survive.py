"""Damaged files: splats or one clear error, soon, in bounded memory, and never a dead process."""

from __future__ import annotations

import pytest

from tests.fuzz.batch import fuzz
from tests.fuzz.layers import LAYERS

INPUTS = 75  # `python -m tests.fuzz` tries thousands


@pytest.mark.slow
@pytest.mark.parametrize("name", LAYERS)
def test_a_damaged_file_is_read_or_refused(name: str) -> None:
    tally = fuzz(name, INPUTS)
    assert tally.read + tally.refused == tally.tried
    assert tally.refused > 0
