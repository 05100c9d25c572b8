"""A turn on the spot and a zoom are found before the search; photographs with parallax are not."""

from __future__ import annotations

from pathlib import Path

import pytest

from stages.base.errors import SplatError
from stages.scene import Capture
from stages.sfm.checks.same_place import check_one_place, same_place
from tests.sfm import room_captures
from tests.sfm.checks import bad_captures


def how(capture: Capture) -> str:
    return same_place(capture.folder, capture.photos)


def test_a_turn_on_the_spot_is_found_in_the_photographs_alone(tmp_path: Path) -> None:
    capture = bad_captures.turning_on_the_spot(tmp_path, 12)
    assert how(capture) == "turning"
    with pytest.raises(SplatError) as caught:
        check_one_place(capture.folder, capture.photos)
    assert caught.value.code == "sfm-no-parallax"
    assert "turning on the spot" in caught.value.hint


@pytest.mark.parametrize("make", [bad_captures.zooming, bad_captures.zooming_into_detail])
def test_a_zoom_is_told_from_a_turn(make, tmp_path: Path) -> None:
    capture = make(tmp_path)
    assert how(capture) == "zooming"
    with pytest.raises(SplatError) as caught:
        check_one_place(capture.folder, capture.photos)
    assert "turning on the spot" not in caught.value.hint


@pytest.mark.parametrize("make", [bad_captures.sample, lambda: bad_captures.sample(6)])
def test_a_walk_has_parallax(make) -> None:
    assert how(make()) == ""


def test_a_walk_along_a_flat_wall_has_parallax(tmp_path: Path) -> None:
    capture, _ = room_captures.same_poster_twice(tmp_path)
    along = tuple(capture.photos[:7])  # before one wall with a poster
    assert same_place(capture.folder, along) == ""


def test_a_blank_wall_says_nothing(tmp_path: Path) -> None:
    assert how(bad_captures.blank(tmp_path)) == ""
