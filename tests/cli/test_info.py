"""`splat info`: what is in a file, and what is wrong with it."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from splatcli.app import app
from stages import formats
from tests.formats.truth import many_splats


def info(path: Path, code: int = 0) -> dict[str, Any]:
    result = CliRunner().invoke(app, ["info", str(path), "--json"])
    assert result.exit_code == code, result.stderr
    return dict(json.loads(result.stdout))


def test_the_size_of_a_gltf_counts_its_bin(tmp_path: Path) -> None:
    formats.write(tmp_path / "a.gltf", many_splats(3000))
    both = sum(path.stat().st_size for path in tmp_path.iterdir())
    facts = info(tmp_path / "a.gltf")
    assert facts["size_bytes"] == both
    assert facts["bytes_per_splat"] == pytest.approx(both / 3000, abs=0.01)


def test_values_that_are_not_finite_are_described_and_not_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    formats.write(path, many_splats(300))
    head, rows = path.read_bytes().split(b"end_header\n", 1)
    table = np.frombuffer(rows, "<f4").reshape(300, 62).copy()
    table[:5, 0] = np.nan  # x
    table[7, 61] = np.inf  # rot_3
    path.write_bytes(head + b"end_header\n" + table.tobytes())
    facts = info(path)
    assert facts["not_finite"] == 6
    assert facts["warnings"]["not-finite-positions"].startswith("5 splats")
    wanted = "1 splat (0.33 %) is not finite in its rotations: no viewer can draw it."
    assert facts["warnings"]["not-finite-rotations"] == wanted
    assert np.isfinite(facts["bounds_high"]).all()
    result = CliRunner().invoke(app, ["info", str(path)])
    assert result.exit_code == 0
    assert "5 splats (1.7 %) are not finite in their positions" in result.stderr


def test_the_table_has_no_empty_line_and_coordinates_as_other_commands_take_them(
    tmp_path: Path,
) -> None:
    formats.write(tmp_path / "a.ply", many_splats(300))
    lines = CliRunner().invoke(app, ["info", str(tmp_path / "a.ply")]).stdout.splitlines()
    assert all(line.strip() for line in lines)
    low = next(line for line in lines if line.startswith("bounds low")).split()[-1]
    assert len([float(value) for value in low.split(",")]) == 3
    assert any(re.fullmatch(r"size +\d+\.\d kB", line.strip()) for line in lines)


def test_a_damaged_file_stays_an_error(tmp_path: Path) -> None:
    (tmp_path / "a.ply").write_bytes(b"ply\nnonsense")
    assert info(tmp_path / "a.ply", code=3)["code"] == "splats-unreadable"


def test_a_usd_file_that_is_not_finite_is_described_too(tmp_path: Path) -> None:
    path = tmp_path / "a.usda"
    formats.write(path, many_splats(3))
    text = path.read_text()
    place = text.index("positions = [(") + len("positions = [(")
    path.write_text(text[:place] + "nan" + text[text.index(",", place) :])
    assert info(path)["warnings"]["not-finite-positions"].startswith("1 splat (")


@pytest.mark.parametrize(("suffix", "floats"), [("ply", 59), ("splat", 14)])
def test_memory_is_reported_at_the_degree_of_the_file(
    tmp_path: Path, suffix: str, floats: int
) -> None:
    formats.write(tmp_path / f"a.{suffix}", many_splats(1000))
    facts = info(tmp_path / f"a.{suffix}")
    assert facts["floats_per_splat"] == floats
    assert facts["memory_bytes"] == 4 * floats * 1000
