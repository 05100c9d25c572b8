"""A condition is comparisons joined by "and", and nothing else is ever run."""

from __future__ import annotations

import numpy as np
import pytest

from stages.base.errors import SplatError
from stages.editing.expression import VARIABLES, parse_expression
from tests import scenes

SPLATS = scenes.splats(
    [[0, 0, 0], [1, 2, 3], [-1, 0, 5]],
    scales=[[0.1, 0.2, 0.3], [1, 1, 1], [0.01, 0.01, 2]],
    opacities=[0.05, 0.5, 0.9],
    rgb=[[1, 0, 0], [0, 1, 0], [0.5, 0.5, 0.5]],
)


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("opacity > 0.1", [False, True, True]),
        ("opacity > 0.1 and scale < 1.5", [False, True, False]),
        ("thickness<.05", [False, False, True]),
        ("x >= -1 and x < 1 and z <= 4", [True, False, False]),
        ("red > 0.9", [True, False, False]),
        ("degree == 0 and z != 3e0", [True, False, True]),
    ],
)
def test_a_condition_says_which_splats_stay(text: str, wanted: list[bool]) -> None:
    assert parse_expression(text)(SPLATS).tolist() == wanted


@pytest.mark.parametrize(
    "text",
    [
        "",
        "opacity",
        "opacity >",
        "opacity > 0.1 and",
        "opacity > 0.1 or x > 1",
        "not x > 1",
        "-1 < x < 1",
        "x + y > 1",
        "__import__('os').system('true')",
        "size > 1",
        "x > y",
        "x = 1",
        "x > nan",
        "x\0 > 1",
    ],
)
def test_anything_else_is_refused_with_the_names_that_there_are(text: str) -> None:
    with pytest.raises(SplatError) as refused:
        parse_expression(text)
    assert refused.value.code == "edit-keep"
    assert all(name in refused.value.wanted for name in VARIABLES)


def test_a_value_that_is_no_number_is_not_kept() -> None:
    broken = scenes.splats([[np.nan, 0, 0], [1, 0, 0]])
    assert parse_expression("x < 5")(broken).tolist() == [False, True]
