"""The listing of the extremes in the documentation."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.extremes.gpu import COLUMNS, kept, on_gpu
from tests.extremes.table import ROWS, listing, promises

LISTING = Path(__file__).parents[2] / "docs" / "experiments" / "extremes.md"


def test_there_is_one_row_for_each_number_of_the_table() -> None:
    assert [row.number for row in ROWS] == list(range(1, len(ROWS) + 1))
    assert len({row.name for row in ROWS}) == len(ROWS)


@pytest.mark.parametrize("real", COLUMNS.values())
def test_a_gpus_column_was_measured_for_every_row_and_holds_its_bounds(real: str) -> None:
    found = kept(real)
    assert {row.number for row in ROWS if on_gpu(row)} == found.keys()
    beyond = [m for numbers in found.values() for m in numbers if not m.accepted]
    assert not beyond


@pytest.mark.slow
@pytest.mark.timeout(300)  # it measures every row on every backend, some in many digits
def test_the_documented_listing_has_every_row_and_its_bounds() -> None:
    documented = promises(LISTING.read_text(encoding="utf-8"))
    assert {row for row, _, _ in documented} == {str(row.number) for row in ROWS}
    assert documented == promises(listing())
