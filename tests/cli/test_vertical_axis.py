"""A .ply whose comment says that another axis than y is vertical, as nerfstudio writes it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from splatcli.app import app
from stages import formats
from tests.formats.truth import many_splats

HEIGHT = 0.1


def result_of(*words: object) -> str:
    """The last line of JSON."""
    result = CliRunner().invoke(app, [*map(str, words), "--json"])
    assert result.exit_code == 0, result.stderr
    return result.stdout.splitlines()[-1]


def warnings_of(*words: object) -> str:
    return json.dumps(json.loads(result_of(*words))["warnings"])


def flat(path: Path, comment: str) -> Path:
    """Splats that lie flat in x and y, with `comment` in the header."""
    splats = many_splats(200)
    means = splats.means * np.array([1, 1, HEIGHT], np.float32) / np.abs(splats.means).max()
    formats.write(path, replace(splats, means=means, origin=np.zeros(3)))
    content = path.read_bytes()
    path.write_bytes(content.replace(b"comment up axis", f"comment {comment}\ncomment up".encode()))
    return path


@pytest.mark.parametrize(
    ("comment", "up"),
    [
        ("Vertical Axis: z", "+z"),
        ("vertical axis: -Z", "-z"),
        ("Vertical Axis: +x", "+x"),
        ("Vertical axis: y", ""),
        ("Vertical axis: unknown", ""),
        ("Vertical Axis", ""),
    ],
)
@pytest.mark.parametrize("ending", ["ply", "compressed.ply"])
def test_a_vertical_axis_is_told_unless_it_is_y(
    tmp_path: Path, comment: str, up: str, ending: str
) -> None:
    path = flat(tmp_path / f"a.{ending}", comment)
    for words in (["info", path], ["convert", path, tmp_path / "b.ply"]):
        found = warnings_of(*words)
        assert (f"--up {up}`" in found) == bool(up)
        assert ("vertical" in found) == bool(up)


def test_the_advice_turns_it_upright(tmp_path: Path) -> None:
    path, upright = flat(tmp_path / "a b.ply", "Vertical Axis: z"), tmp_path / "b.glb"
    assert f"`splat edit '{path}' {upright} --up +z`" in warnings_of("convert", path, upright)
    assert "vertical" in warnings_of("edit", path, tmp_path / "c.ply", "--scale", "2")
    assert warnings_of("edit", path, upright, "--up", "+z") == "[]"
    size = np.ptp(formats.read(upright).means, axis=0)
    assert size[1] < 3 * HEIGHT < min(size[0], size[2])
    assert warnings_of("info", upright).count("vertical") == 0
    again = warnings_of("edit", path, path, "--rotate", "x:90")  # in its place
    assert "vertical" not in again
    assert "vertical" not in warnings_of("info", path)


def test_the_vertical_axis_of_a_merged_file_is_told(tmp_path: Path) -> None:
    path, lying = flat(tmp_path / "a.ply", "x"), flat(tmp_path / "b.ply", "Vertical Axis: z")
    merge = "edit", path, tmp_path / "c.ply", "--merge", lying
    assert f"splat edit {lying} upright.ply --up +z" in warnings_of(*merge)
    assert warnings_of(*merge, "--up", "+z") == "[]"


def test_the_coordinates_stay_those_of_the_file(tmp_path: Path) -> None:
    plain, said = flat(tmp_path / "a.ply", "x"), flat(tmp_path / "b.ply", "Vertical Axis: z")
    assert (formats.read(plain).means == formats.read(said).means).all()
