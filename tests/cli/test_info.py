"""`splat info`: what is in a file, and what is wrong with it."""

from __future__ import annotations

import json
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


# degree 3: 15 coefficients of 3 channels above degree 0
BYTES = {
    "ply": {"positions": 12, "normals": 12, "colours": 12, "SH": 180, "scales": 12},
    "splat": {"positions": 12, "scales": 12, "colours, opacities": 4, "rotations": 4},
    "glb": {"positions": 12, "rotations": 16, "SH": 180, "opacities": 4},
    "quantised.glb": {"positions": 12, "rotations": 8, "scales": 6, "opacities": 2},
    "compressed.ply": {"positions": 4, "rotations": 4, "SH": 45},
}


@pytest.mark.parametrize("suffix", BYTES)
def test_bytes_are_reported_by_attribute(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a.{suffix}"
    formats.write(path, many_splats(300))
    facts = info(path)
    assert facts["splats"] == 300
    assert facts["bytes_per_splat"].items() >= BYTES[suffix].items()
    assert sum(facts["bytes_per_splat"].values()) * 300 == pytest.approx(path.stat().st_size, 1e-3)


def test_bytes_of_packed_files_are_those_on_disk_where_parts_are_packed_alone(
    tmp_path: Path,
) -> None:
    formats.write(tmp_path / "a.sog", many_splats(300))
    facts = info(tmp_path / "a.sog")["bytes_per_splat"]
    size = (tmp_path / "a.sog").stat().st_size
    assert sum(facts.values()) * 300 == pytest.approx(size, 1e-2)
    formats.write(tmp_path / "a.spz", many_splats(300))  # gzip packs all together
    facts = info(tmp_path / "a.spz")["bytes_per_splat_unpacked"]
    assert facts == {
        "positions": 9,
        "opacities": 1,
        "colours": 3,
        "scales": 3,
        "rotations": 4,
        "SH": 45,
    }
    formats.write(tmp_path / "a.html", many_splats(300))  # a .ply, gzip and base64
    facts = info(tmp_path / "a.html")["bytes_per_splat_unpacked"]
    assert (facts["positions"], facts["SH"]) == (12, 180)


def test_a_format_without_a_byte_breakdown_says_so(tmp_path: Path) -> None:
    formats.write(tmp_path / "a.usdc", many_splats(3))
    facts = info(tmp_path / "a.usdc")
    assert "how many bytes" in facts["bytes_per_splat_unknown"]
    assert "bytes_per_splat" not in facts


def test_the_size_of_a_gltf_counts_its_bin(tmp_path: Path) -> None:
    formats.write(tmp_path / "a.gltf", many_splats(3000))
    both = sum(path.stat().st_size for path in tmp_path.iterdir())
    assert info(tmp_path / "a.gltf")["size_bytes"] == both


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
    assert facts["warnings"]["not-finite-rotations"].startswith("1 splats")
    assert np.isfinite(facts["bounds_high"]).all()
    result = CliRunner().invoke(app, ["info", str(path)])
    assert result.exit_code == 0
    assert "5 splats (1.7 %) are not finite in their positions" in result.stderr


def test_a_damaged_file_stays_an_error(tmp_path: Path) -> None:
    (tmp_path / "a.ply").write_bytes(b"ply\nnonsense")
    assert info(tmp_path / "a.ply", code=3)["code"] == "splats-unreadable"


def test_a_usd_file_that_is_not_finite_is_described_too(tmp_path: Path) -> None:
    path = tmp_path / "a.usda"
    formats.write(path, many_splats(3))
    text = path.read_text()
    place = text.index("positions = [(") + len("positions = [(")
    path.write_text(text[:place] + "nan" + text[text.index(",", place) :])
    assert info(path)["warnings"]["not-finite-positions"].startswith("1 splats")


@pytest.mark.parametrize(("suffix", "floats"), [("ply", 59), ("splat", 14)])
def test_memory_is_reported_at_the_degree_of_the_file(
    tmp_path: Path, suffix: str, floats: int
) -> None:
    formats.write(tmp_path / f"a.{suffix}", many_splats(1000))
    facts = info(tmp_path / f"a.{suffix}")
    assert facts["floats_per_splat"] == floats
    assert facts["memory_bytes"] == 4 * floats * 1000


def test_speed_is_measured_on_request_with_its_conditions(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    formats.write(path, many_splats(300))
    assert "frames_a_second" not in info(path)
    result = CliRunner().invoke(app, ["info", str(path), "--speed", "--json"])
    facts = json.loads(result.stdout)
    assert facts["frames_a_second"] > 0
    assert (facts["frame_width"], facts["frame_height"], facts["frames_timed"]) == (
        960,
        720,
        8,
    )
    assert facts["splats"] == 300
