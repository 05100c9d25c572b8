"""Pairs that show an object turned before a background that stands still."""

from __future__ import annotations

import pytest

from tests.sfm.synthetic import random_rotation

pytest.importorskip("pycolmap")


def test_pairs_that_agree_on_one_turn_or_its_inverse_are_found_among_others() -> None:
    from stages.sfm.worker.pair_checks import FEWEST_TURNED, _turned_pairs

    turn = random_rotation(1)
    turns = [turn, None, turn.T, random_rotation(2), turn, random_rotation(3), turn.T, turn]
    assert _turned_pairs(turns) == [0, 2, 4, 6, 7]
    assert len(_turned_pairs(turns)) == FEWEST_TURNED
    assert _turned_pairs(turns[:-1]) == []
    assert _turned_pairs([random_rotation(seed) for seed in range(30)]) == []
    assert _turned_pairs([None] * 9) == []
