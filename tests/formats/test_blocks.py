"""Going over rows a block at a time, and telling who watches."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from stages import formats
from stages.formats import blocks
from stages.proof.compare import differences
from stages.proof.second_readers import read_back
from tests.formats.truth import many_splats

QUICK = [name for name in formats.FORMATS if not name.startswith("usd")]


@pytest.mark.parametrize(("count", "rows"), [(0, 4), (1, 4), (4, 4), (9, 4)])
def test_blocks_hold_every_row_once(count: int, rows: int) -> None:
    parts = [np.arange(count)[part] for part in blocks.blocks(count, rows)]
    assert all(0 < len(part) <= rows for part in parts)
    np.testing.assert_array_equal(np.concatenate([[], *parts]), np.arange(count))


def test_a_pass_is_told_to_its_end_and_only_inside() -> None:
    told: list[tuple[int, int]] = []
    with blocks.watched(lambda done, total: told.append((done, total))):
        list(blocks.passing(9, 4))
    list(blocks.passing(9, 4))
    assert told == [(4, 9), (8, 9), (9, 9)]


@pytest.mark.parametrize("suffix", QUICK)
def test_reading_and_writing_are_told(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a.{suffix}"
    told: list[tuple[int, int]] = []
    with blocks.watched(lambda done, total: told.append((done, total))):
        formats.write(path, many_splats(40))
        if suffix not in ("glb", "gltf", "quantised.glb"):
            assert (40, 40) in told
            told.clear()
            formats.read(path)
            assert told
    assert all(0 < done <= total for done, total in told)


@pytest.mark.parametrize("suffix", ["ply", "splat", "compressed.ply", "spz", "sog", "html", "usdc"])
def test_more_rows_than_a_block_come_back(tmp_path: Path, suffix: str) -> None:
    """Rows, and what belongs to them, stay together over the edges of blocks."""
    count = blocks.ROWS + 300
    splats = many_splats(count).with_sh_degree(1)
    path = tmp_path / f"a.{suffix}"
    formats.write(path, splats)
    found = differences(splats, read_back(path), suffix)
    assert found.wrong == ()
    if suffix in ("ply", "html", "usdc"):
        np.testing.assert_array_equal(formats.read(path).sh, splats.sh)
