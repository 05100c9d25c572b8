"""Words that depend on a number."""

from __future__ import annotations

import pytest

from stages.base.text import counted


@pytest.mark.parametrize(
    ("count", "text"), [(0, "0 photographs"), (1, "1 photograph"), (1200, "1,200 photographs")]
)
def test_noun_agrees_with_its_number(count: int, text: str) -> None:
    assert counted(count, "photograph") == text


def test_plural_that_takes_more_than_an_s() -> None:
    assert counted(1, "box", "boxes") == "1 box"
    assert counted(2, "box", "boxes") == "2 boxes"
