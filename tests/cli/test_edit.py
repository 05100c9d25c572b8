"""`splat edit`: operations in the order in which they are typed, told one by one."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from splatcli.app import app
from splatcli.commands import edit as command
from stages import formats
from stages.base import scratch
from stages.editing import operations
from stages.editing.scene import EditedScene
from stages.editing.syntax import OPERATIONS
from stages.scene import Splats, View, look_at
from tests import scenes
from tests.cli.help_text import help_of
from tests.formats.truth import many_splats

QUICK = [name for name in formats.FORMATS if not name.startswith("usd")]


def edited(*words: object, code: int = 0) -> tuple[str, str]:
    """(standard output, standard error)."""
    result = CliRunner().invoke(app, ["edit", *map(str, words)])
    assert result.exit_code == code, result.stderr
    return result.stdout, result.stderr


@pytest.fixture
def source(tmp_path: Path) -> Path:
    formats.write(tmp_path / "a.ply", many_splats(300), units="metres")
    return tmp_path / "a.ply"


def result_of(path: Path) -> Splats:
    return formats.read(path)


def test_operations_are_applied_in_the_order_of_the_command_line(
    source: Path, tmp_path: Path
) -> None:
    box, out = "box:-9,-9,-9,9,9,9", tmp_path / "b.ply"
    edited(source, out, "--move", "-1,0,0", "--scale", "2", "--crop", box, "--move=0,5,0")
    first = result_of(out)
    edited(source, out, "--crop", box, "--move=0,5,0", "--scale=2", "--move", "-1,0,0")
    second = result_of(out)
    means = result_of(source).means
    wanted = (means - (1, 0, 0)) * 2
    inside = (np.abs(wanted) <= 9).all(1)
    np.testing.assert_allclose(first.means, wanted[inside] + (0, 5, 0), atol=1e-5)
    inside = (np.abs(means) <= 9).all(1)
    np.testing.assert_allclose(second.means, (means[inside] + (0, 5, 0)) * 2 - (1, 0, 0), atol=1e-5)


@pytest.mark.parametrize("ending", QUICK)
def test_every_format_comes_in_and_goes_out(tmp_path: Path, ending: str) -> None:
    formats.write(tmp_path / f"a.{ending}", many_splats(40))
    edited(tmp_path / f"a.{ending}", tmp_path / f"b.{ending}", "--decimate", "25%", "--quiet")
    assert len(result_of(tmp_path / f"b.{ending}")) == 10


def test_files_of_different_degrees_are_merged_and_keep_theirs(
    source: Path, tmp_path: Path
) -> None:
    formats.write(tmp_path / "c.ply", many_splats(20).with_sh_degree(1))
    edited(tmp_path / "c.ply", tmp_path / "b.ply", "--merge", source)
    found, a, c = map(result_of, (tmp_path / "b.ply", source, tmp_path / "c.ply"))
    assert len(found) == 320
    np.testing.assert_array_equal(found.means, np.concatenate([c.means, a.means]))
    np.testing.assert_array_equal(found.sh_degrees, [*c.sh_degrees, *a.sh_degrees])
    np.testing.assert_array_equal(found.sh[20:], a.sh)


def test_merged_files_meet_in_the_coordinates_of_their_capture(tmp_path: Path) -> None:
    splats = many_splats(9)
    formats.write(tmp_path / "a.ply", replace(splats, origin=np.array([1000.0, 0, 0])))
    formats.write(tmp_path / "c.ply", replace(splats, origin=np.array([1003.0, 0, 0])))
    edited(tmp_path / "a.ply", tmp_path / "b.ply", "--merge", tmp_path / "c.ply")
    found = result_of(tmp_path / "b.ply")
    np.testing.assert_allclose(found.means[9:] - found.means[:9], [[3, 0, 0]] * 9, atol=1e-5)


def test_files_too_far_apart_for_32_bits_are_not_merged(tmp_path: Path) -> None:
    splats = replace(many_splats(100), origin=np.zeros(3))
    formats.write(tmp_path / "near.ply", splats)
    formats.write(tmp_path / "far.ply", replace(splats, origin=np.array([4e6 + 0.3, 0, 0])))
    words = (tmp_path / "near.ply", tmp_path / "b.ply")
    _, err = edited(*words, "--merge", tmp_path / "far.ply", code=2)
    assert "edit-merge-far" in err
    assert "4,000,000 units apart" in err
    assert not (tmp_path / "b.ply").exists()
    edited(*words, "--move", "4000000,0,0", "--merge", tmp_path / "far.ply")
    found = result_of(tmp_path / "b.ply")
    np.testing.assert_allclose(
        found.means[100:] - found.means[:100], [[0.3, 0, 0]] * 100, atol=1e-5
    )


def test_a_move_farther_than_float64_is_precise_moves_the_origin_alone(
    source: Path, tmp_path: Path
) -> None:
    edited(source, tmp_path / "b.ply", "--move", "1e300,0,0")
    np.testing.assert_array_equal(result_of(tmp_path / "b.ply").means, result_of(source).means)


def test_metres_stay_metres_until_the_scene_is_scaled(source: Path, tmp_path: Path) -> None:
    edited(source, tmp_path / "b.glb", "--move", "1,2,3", "--rotate", "x:20")
    assert formats.units_of(tmp_path / "b.glb") == "metres"
    edited(source, tmp_path / "b.ply", "--scale", "2")
    assert formats.units_of(tmp_path / "b.ply") == "arbitrary"


def test_a_file_is_at_most_as_large_as_max_mb(source: Path, tmp_path: Path) -> None:
    formats.write(source, many_splats(3000))
    edited(source, tmp_path / "b.ply", "--max-mb", "0.2")
    assert 0.19e6 < (tmp_path / "b.ply").stat().st_size <= 0.2e6
    _, err = edited(source, tmp_path / "c.ply", "--max-mb", "0.000002", code=2)
    assert "edit-too-small" in err
    assert not (tmp_path / "c.ply").exists()


@pytest.mark.parametrize("count", [1, 20, 3000])
def test_a_size_that_is_mostly_the_page_is_met(source: Path, tmp_path: Path, count: int) -> None:
    formats.write(source, many_splats(5000))
    formats.write(tmp_path / "few.html", many_splats(count))
    wanted = 1.001 * (tmp_path / "few.html").stat().st_size
    edited(source, tmp_path / "b.html", "--max-mb", wanted / 1e6)
    assert (tmp_path / "b.html").stat().st_size <= wanted
    assert len(result_of(tmp_path / "b.html")) > 0.75 * count


def test_the_last_decimation_to_a_size_is_measured(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(operations, "_ATTEMPTS", 1)
    edited(source, tmp_path / "b.ply", "--max-mb", "0.02")
    assert (tmp_path / "b.ply").stat().st_size <= 20_000


def test_a_size_that_one_splat_exceeds_is_refused_at_once(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(operations, "decimate", lambda *_: 1 / 0)
    _, err = edited(source, tmp_path / "c.ply", "--max-mb", "0.0015", code=2)
    assert "less than 1 splat needs as .ply" in err


def test_degree_and_floaters(source: Path, tmp_path: Path) -> None:
    splats = many_splats(300)
    means = np.concatenate([np.random.default_rng(0).normal(0, 1, (299, 3)), [[60, 0, 0]]])
    alone = replace(splats, means=means.astype(np.float32), log_scales=splats.log_scales * 0 - 3)
    formats.write(source, alone)
    edited(source, tmp_path / "b.ply", "--drop-floaters", "--degree", "1")
    found = result_of(tmp_path / "b.ply")
    assert found.sh_degree == 1
    assert found.means[:, 0].max() < 10
    assert len(found) > 290


def test_a_dry_run_reports_the_removal_and_writes_nothing(source: Path, tmp_path: Path) -> None:
    before = sorted(tmp_path.iterdir())
    out, err = edited(source, "--keep", "x > 0", "--decimate", "10", "--dry-run")
    kept = int((result_of(source).means[:, 0] > 0).sum())
    assert out == ""
    assert f"--keep x > 0: 300 -> {kept} splats" in err
    assert f"--decimate 10: {kept} -> 10 splats" in err
    assert "Nothing was written" in err
    edited(source, tmp_path / "new" / "x.spz", "--max-mb", "0.002", "--dry-run")
    assert sorted(tmp_path.iterdir()) == before


def test_events_are_lines_of_json(source: Path, tmp_path: Path) -> None:
    out, err = edited(source, tmp_path / "b.ply", "--decimate", "10", "--json")
    step, last = [json.loads(line) for line in out.splitlines()]
    assert (step["event"], step["splats_before"], step["splats"]) == ("operation", 300, 10)
    assert (last["event"], last["splats"], last["units"]) == ("edited", 10, "metres")
    assert last["size_bytes"] == (tmp_path / "b.ply").stat().st_size
    assert err == ""


def test_where_cameras_are_known_what_is_written_is_proven(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    camera = scenes.camera(matrix=look_at(np.array([0.0, -1.0, -9.0]), np.zeros(3)))
    known = EditedScene(result_of(source), views=(View("a", "", camera),))
    monkeypatch.setattr(command, "_load_scene", lambda path, antialias: (known, 0))
    _, err = edited(source, tmp_path / "b.ply", "--scale", "2", "--rotate", "x:30")
    assert "read back and drawn again" in err
    out, _ = edited(source, tmp_path / "b.glb", "--move", "1,0,0", "--json")
    assert json.loads(out.splitlines()[-1])["verify_db"] > 60
    right = formats.write

    def wrong(path: Path, splats: Splats, **more: Any) -> int:
        return right(path, replace(splats, means=splats.means * [1, -1, 1]), **more)

    monkeypatch.setattr(formats, "write", wrong)
    _, err = edited(source, tmp_path / "c.ply", "--move", "1,0,0", code=7)
    assert "edit-verify-failed" in err


@pytest.mark.parametrize(
    ("words", "code", "status"),
    [
        (["--keep", "x >"], "edit-keep", 2),
        (["--crop", "cube:1"], "edit-region", 2),
        (["--crop", "hull:none.json"], "edit-region", 2),
        (["--rotate", "y"], "edit-rotate", 2),
        (["--rotate", "0,0,0:20"], "edit-rotate", 2),
        (["--rotate", "x:1e300"], "edit-rotate", 2),
        (["--scale", "0"], "edit-scale", 2),
        (["--scale", "nan"], "edit-scale", 2),
        (["--move", "1,2"], "edit-move", 2),
        (["--up", "w"], "edit-up", 2),
        (["--up", ""], "edit-up", 2),
        (["--degree", "4"], "edit-degree", 2),
        (["--degree", "1.5"], "edit-degree", 2),
        (["--decimate", "0"], "edit-decimate", 2),
        (["--decimate", "101%"], "edit-decimate", 2),
        (["--max-mb", "-1"], "edit-max-mb", 2),
        (["--merge", "none.ply"], "file-missing", 3),
        (["--merge", "none.obj"], "format-unknown", 2),
        (["--keep", "x > 1e9"], "edit-nothing-left", 2),
        (["--spin", "3"], "command-line", 2),
        (["--keep"], "command-line", 2),
    ],
)
def test_bad_operations_are_reported_and_nothing_is_written(
    source: Path, tmp_path: Path, words: list[str], code: str, status: int
) -> None:
    _, err = edited(source, tmp_path / "b.ply", *words, code=status)
    assert f"({code}, exit status {status})" in err
    assert not (tmp_path / "b.ply").exists()


def test_a_target_with_a_known_suffix_is_required(source: Path, tmp_path: Path) -> None:
    _, err = edited(source, code=2)
    assert "edit-no-target" in err
    edited(source, tmp_path / "b.obj", code=2)
    edited(source, source / "b.ply", code=6)  # a file is no folder


def test_splats_that_no_viewer_can_draw_are_left_out_first(source: Path, tmp_path: Path) -> None:
    content = source.read_bytes()
    huge = np.float32(60).tobytes()  # exp(60) cannot be squared in float32
    source.write_bytes(content[:-20] + huge + content[-16:])
    _, err = edited(source, tmp_path / "b.ply", "--decimate", "50%")
    assert len(result_of(tmp_path / "b.ply")) == 150
    assert "no viewer can draw: 1 splat." in " ".join(err.split())


def test_what_the_new_file_cannot_hold_is_reported(source: Path, tmp_path: Path) -> None:
    far = replace(result_of(source).with_antialias(True), origin=np.array([1e6, 2e6, 3.0]))
    formats.write(source, far)
    _, err = edited(source, tmp_path / "b.spz", "--quiet")
    assert "b.spz.offset.json" in err
    out, _ = edited(source, tmp_path / "b.splat", "--json")
    lossy, drawing, origin = json.loads(out.splitlines()[-1])["warnings"]
    assert "do not change with the view" in lossy
    assert "antialiased drawing" in drawing
    assert "b.splat.offset.json" in origin
    out, _ = edited(source, tmp_path / "b.glb", "--scale", "1e9", "--scale", "1e9", "--json")
    last = json.loads(out.splitlines()[-1])
    assert last["splats"] + last["dropped"] == 300


def test_a_file_can_be_edited_in_its_place_and_through_the_disk(
    source: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ("--rotate", "y:30", "--keep", "x > 0", "--decimate", "50%")
    edited(source, source.with_name("b.ply"), *words)
    monkeypatch.setattr(scratch, "LARGE_BYTES", 1)
    edited(source, source, *words)
    assert source.read_bytes() == source.with_name("b.ply").read_bytes()


def test_levels_of_detail_go_into_a_folder_that_is_made(source: Path, tmp_path: Path) -> None:
    target = tmp_path / "new" / "lod-meta.json"
    edited(source, target, "--scale", "2", "--dry-run")
    assert not target.parent.exists()
    edited(source, target, "--scale", "2")
    assert len(result_of(target)) == 300
    edited(target, tmp_path / "b.ply", "--decimate", "10")
    assert len(result_of(tmp_path / "b.ply")) == 10


def test_help_names_every_operation() -> None:
    text = help_of("edit")
    for word in (*OPERATIONS, "dry-run"):
        assert f"--{word}" in text
