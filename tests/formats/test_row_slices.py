"""Files of more rows than a block."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from stages import formats
from stages.base import row_slices
from stages.proof.checks import read_back
from stages.proof.compare import differences
from tests.formats.truth import many_splats


@pytest.mark.parametrize("suffix", ["ply", "splat", "compressed.ply", "spz", "sog", "html", "usdc"])
def test_more_rows_than_a_block_come_back(tmp_path: Path, suffix: str) -> None:
    """Rows, and what belongs to them, stay together over the edges of blocks."""
    count = row_slices.ROWS + 300
    splats = many_splats(count).with_sh_degree(1)
    path = tmp_path / f"a.{suffix}"
    formats.write(path, splats)
    found = differences(splats, read_back(path), suffix)
    assert found.wrong == {}
    if suffix in ("ply", "html", "usdc"):
        np.testing.assert_array_equal(formats.read(path).sh, splats.sh)
