"""Going over rows a block at a time, and telling who watches."""

from __future__ import annotations

import numpy as np
import pytest

from stages.base import blocks


@pytest.mark.parametrize(("count", "rows"), [(0, 4), (1, 4), (4, 4), (9, 4)])
def test_blocks_hold_every_row_once(count: int, rows: int) -> None:
    parts = [np.arange(count)[part] for part in blocks.blocks(count, rows)]
    assert all(0 < len(part) <= rows for part in parts)
    np.testing.assert_array_equal(np.concatenate([[], *parts]), np.arange(count))


def test_a_pass_is_told_to_its_end_and_only_inside() -> None:
    reported: list[tuple[int, int]] = []
    with blocks.progress_reported_to(lambda done, total: reported.append((done, total))):
        list(blocks.reported_blocks(9, 4))
    list(blocks.reported_blocks(9, 4))
    assert reported == [(4, 9), (8, 9), (9, 9)]
