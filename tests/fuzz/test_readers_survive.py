"""Damaged files: splats or one clear error, soon, in bounded memory, and never a dead process."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.fuzz.batch import fuzz, journal
from tests.fuzz.layers import LAYERS

_IGNORED = ("photograph, Exif", "photograph, colour profile")  # damaged, they count as none
INPUTS = 75  # `python -m tests.fuzz` tries as many as it is given


@pytest.mark.slow
@pytest.mark.parametrize("name", LAYERS)
def test_a_damaged_file_is_read_or_refused(name: str, tmp_path: Path) -> None:
    (tally,) = fuzz(name, INPUTS, tmp_path)
    assert not tally.beaten
    assert tally.read + tally.refused == tally.tried == INPUTS
    assert tally.refused > 0 or name in _IGNORED
    assert journal(tmp_path) == [tally]
    assert not list(fuzz(name, INPUTS, tmp_path))  # nothing is left to do
