"""Parts of space."""

from __future__ import annotations

import numpy as np
import pytest

from stages.base.errors import SplatError
from stages.editing.regions import parse_region
from tests import scenes

MEANS = np.random.default_rng(3).uniform(-2, 2, (500, 3))
CENTRES = scenes.splats(MEANS).means.astype(np.float64)


def test_a_box_and_a_ball() -> None:
    box = parse_region("box:-1,-1,-1,1,1.5,2")(CENTRES)
    means = CENTRES
    assert (box == ((means >= -1) & (means <= [1, 1.5, 2])).all(1)).all()
    ball = parse_region("sphere:0.5,0,0,1.2")(CENTRES)
    assert (ball == (np.linalg.norm(means - [0.5, 0, 0], axis=1) <= 1.2)).all()
    assert 0 < ball.sum() < 500


def test_a_lasso_is_what_lies_before_the_camera_and_within_its_corners() -> None:
    """By hand: a camera at z = -1 that looks along z, 100 pixels to the unit; an L of corners."""
    view = "100,0,0,0,0,100,0,0,0,0,1,1"
    found = parse_region(f"lasso:{view},0,0,100,0,100,50,50,50,50,100,0,100")(CENTRES)
    x, y, z = CENTRES.T
    u, v = 100 * x / (z + 1), 100 * y / (z + 1)
    whole = (z > -1) & (u > 0) & (v > 0) & (u < 100) & (v < 100)
    assert (found == whole & ~((u > 50) & (v > 50))).all()
    assert 10 < found.sum() < 200


@pytest.mark.parametrize(
    "text",
    [
        *("lasso:", "lasso:1,2,3", "lasso:" + "1," * 15 + "1", "lasso:" + "1," * 18 + "1"),
        *("box", "box:1,2,3", "box:1,1,1,0,0,0", "box:a,b,c,d,e,f"),
        *("sphere:0,0,0,-1", "sphere:0,0,0,nan", "ball:0,0,0,1", "", "hull:a.json"),
    ],
)
def test_what_names_no_part_of_space_is_refused(text: str) -> None:
    with pytest.raises(SplatError) as refused:
        parse_region(text)
    assert refused.value.code == "edit-region"
