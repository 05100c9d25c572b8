"""Files of more rows than a block, and who watches how far they are."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from stages import formats
from stages.base import blocks
from stages.proof.checks import read_back
from stages.proof.compare import differences
from tests.formats.truth import many_splats

QUICK = [name for name in formats.FORMATS if not name.startswith("usd")]


@pytest.mark.parametrize("suffix", QUICK)
def test_reading_and_writing_report_progress(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a.{suffix}"
    reported: list[tuple[int, int]] = []
    with blocks.progress_reported_to(lambda done, total: reported.append((done, total))):
        formats.write(path, many_splats(40))
        if suffix not in ("glb", "gltf", "quantised.glb"):
            assert (40, 40) in reported
            reported.clear()
            formats.read(path)
            assert reported
    assert all(0 < done <= total for done, total in reported)


@pytest.mark.parametrize("suffix", ["ply", "splat", "compressed.ply", "spz", "sog", "html", "usdc"])
def test_more_rows_than_a_block_come_back(tmp_path: Path, suffix: str) -> None:
    """Rows, and what belongs to them, stay together over the edges of blocks."""
    count = blocks.ROWS + 300
    splats = many_splats(count).with_sh_degree(1)
    path = tmp_path / f"a.{suffix}"
    formats.write(path, splats)
    found = differences(splats, read_back(path), suffix)
    assert found.wrong == {}
    if suffix in ("ply", "html", "usdc"):
        np.testing.assert_array_equal(formats.read(path).sh, splats.sh)
