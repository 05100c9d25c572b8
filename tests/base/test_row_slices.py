"""Going over rows a block at a time."""

from __future__ import annotations

import numpy as np
import pytest

from stages.base import row_slices


@pytest.mark.parametrize(("count", "rows"), [(0, 4), (1, 4), (4, 4), (9, 4)])
def test_blocks_hold_every_row_once(count: int, rows: int) -> None:
    parts = [np.arange(count)[part] for part in row_slices.row_slices(count, rows)]
    assert all(0 < len(part) <= rows for part in parts)
    np.testing.assert_array_equal(np.concatenate([[], *parts]), np.arange(count))
