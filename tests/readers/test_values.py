"""Readers that we did not write find in our files the numbers that we put there."""

from __future__ import annotations

import importlib.util
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stages import formats
from stages.proof.checks import read_back
from stages.proof.compare import differences
from tests.formats.truth import many_splats
from tests.packages import UnavailableError
from tests.readers.values import READERS, Reader
from tests.tolerances import READERS_AGREE, SPLAT_BYTES_DEGREES

pytestmark = pytest.mark.slow
# A wheel of 400 MB: tried where somebody has it.
TRIED = [r for r in READERS if r.name != "Open3D" or importlib.util.find_spec("open3d")]


@pytest.mark.parametrize(
    ("reader", "suffix"),
    [pytest.param(r, name, id=f"{r.name}-{name}") for r in TRIED for name in r.formats],
)
@pytest.mark.parametrize("degree", [0, 2, 3])
@pytest.mark.usefixtures("packages")
def test_other_readers_find_what_was_written(
    tmp_path: Path, reader: Reader, suffix: str, degree: int
) -> None:
    splats = replace(many_splats().with_sh_degree(degree), origin=np.zeros(3))
    path = tmp_path / formats.BY_ENDING[suffix].file_name("a")
    formats.write(path, splats)
    try:
        content = reader.read(path)
    except UnavailableError as reason:
        pytest.skip(str(reason))
    assert len(content.splats) == len(splats)
    # What the format itself loses, tests/formats checks against values known by hand.
    allowed = differences(splats, read_back(path), suffix).largest
    for name, error in differences(splats, content, suffix).largest.items():
        if suffix == "splat" and name == "max_rotation_error_degrees":
            assert error < SPLAT_BYTES_DEGREES
        else:
            assert error <= allowed[name] + READERS_AGREE, name
