"""`splat convert`: names decide the formats, and the difference is told."""

from __future__ import annotations

import itertools
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from splatcli.app import app
from stages import formats
from stages.base import scratch
from stages.editing import levels
from stages.formats.mesh_table import MESHES
from stages.proof import checks
from tests.cli.help_text import help_of
from tests.formats.truth import many_splats

QUICK = [name for name in formats.FORMATS if not name.startswith("usd")]  # USD is a process each


def converted(*words: object, code: int = 0) -> tuple[str, str]:
    """(standard output, standard error)."""
    result = CliRunner().invoke(app, ["convert", *map(str, words)])
    assert result.exit_code == code, result.stderr
    return result.stdout, result.stderr


@pytest.mark.parametrize(("source", "target"), list(itertools.product(QUICK, QUICK)))
def test_any_format_becomes_any_other(tmp_path: Path, source: str, target: str) -> None:
    formats.write(tmp_path / f"a.{source}", many_splats(20))
    converted(tmp_path / f"a.{source}", tmp_path / f"b.{target}", "--quiet")
    assert len(formats.read(tmp_path / f"b.{target}")) == 20


@pytest.mark.parametrize("name", ["lod-meta.json", "tileset.json"])
def test_streamed_assets_get_levels_of_detail(
    tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(levels, "_FEWEST", 300)
    formats.write(tmp_path / "a.ply", many_splats(2000))
    converted(tmp_path / "a.ply", tmp_path / "converted" / name)
    edited = CliRunner().invoke(app, ["edit", str(tmp_path / "a.ply"), str(tmp_path / "e" / name)])
    assert edited.exit_code == 0, edited.stderr
    both = [json.loads((tmp_path / folder / name).read_text()) for folder in ("converted", "e")]
    assert both[0] == both[1]


@pytest.mark.parametrize("ending", ["ply", "splat", "sog"])
def test_the_result_through_scratch_files_is_the_same(
    tmp_path: Path, ending: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As large scenes go."""
    formats.write(tmp_path / "a.ply", many_splats(3000))
    first, again = (tmp_path / f"{name}.{ending}" for name in "bc")
    told = converted(tmp_path / "a.ply", first)[1]
    monkeypatch.setattr(scratch, "LARGE_BYTES", 1)
    assert converted(tmp_path / "a.ply", again)[1] == told.replace("b." + ending, "c." + ending)
    assert first.read_bytes() == again.read_bytes()


def with_nan(path: Path, rows: slice) -> Path:
    """A PLY of 20 splats whose x are not numbers in `rows`."""
    formats.write(path, many_splats(20))
    head, values = path.read_bytes().split(b"end_header\n", 1)
    table = np.frombuffer(values, "<f4").reshape(20, 62).copy()
    table[rows, 0] = np.nan
    path.write_bytes(head + b"end_header\n" + table.tobytes())
    return path


@pytest.mark.parametrize("command", [["convert"], ["edit", "--scale", "2"]])
def test_splats_that_are_not_finite_are_left_out_and_counted(
    tmp_path: Path, command: list[str]
) -> None:
    source, target = with_nan(tmp_path / "a.ply", slice(3)), tmp_path / "b.spz"
    words = [command[0], str(source), str(target), *command[1:]]
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 0, result.stderr
    assert "3 splats" in result.stderr
    assert len(formats.read(target)) == 17
    again = CliRunner().invoke(app, [*words, "--json"])
    assert json.loads(again.stdout.splitlines()[-1])["dropped"] == 3


@pytest.mark.parametrize("command", [["convert"], ["edit", "--scale", "2"]])
def test_a_file_with_hardly_a_finite_splat_is_damaged(tmp_path: Path, command: list[str]) -> None:
    source, target = with_nan(tmp_path / "a.ply", slice(15)), tmp_path / "b.spz"
    result = CliRunner().invoke(app, [command[0], str(source), str(target), *command[1:]])
    assert result.exit_code == 3, result.stderr
    assert "not finite" in result.stderr
    assert not target.exists()


def test_usd_is_read_and_written_too(tmp_path: Path) -> None:
    formats.write(tmp_path / "a.usdz", many_splats(20))
    converted(tmp_path / "a.usdz", tmp_path / "b.spz")
    converted(tmp_path / "b.spz", tmp_path / "c.usda")
    assert "ParticleField3DGaussianSplat" in (tmp_path / "c.usda").read_text()


def test_the_written_files_are_printed(tmp_path: Path) -> None:
    formats.write(tmp_path / "a.ply", many_splats(300))
    out, err = converted(tmp_path / "a.ply", tmp_path / "b.compressed.ply")
    assert out == ""
    assert "reading" in err
    assert "300 splats" in err
    assert "max position error" in err
    _, quiet = converted(tmp_path / "a.ply", tmp_path / "b.glb", "--quiet")
    assert quiet.count("\n") == 1


def test_events_are_lines_of_json(tmp_path: Path) -> None:
    formats.write(tmp_path / "a.ply", many_splats(300))
    out, err = converted(tmp_path / "a.ply", tmp_path / "b.sog", "--json")
    *steps, last = [json.loads(line) for line in out.splitlines()]
    assert [step["done"] for step in steps] == [0, 1, 2]
    assert (last["event"], last["splats"], last["dropped"]) == ("converted", 300, 0)
    assert last["size_bytes"] == (tmp_path / "b.sog").stat().st_size
    assert 0 < last["max_opacity_error"] < 0.01
    assert err == ""


def test_the_size_of_a_gltf_counts_its_bin(tmp_path: Path) -> None:
    formats.write(tmp_path / "a.ply", many_splats(9))
    out, _ = converted(tmp_path / "a.ply", tmp_path / "b.gltf", "--json")
    sizes = sum((tmp_path / name).stat().st_size for name in ("b.gltf", "b.bin"))
    assert json.loads(out.splitlines()[-1])["size_bytes"] == sizes


def test_splats_that_cannot_be_drawn_are_counted(tmp_path: Path) -> None:
    splats = many_splats(5)
    formats.write(tmp_path / "a.ply", splats)
    content = (tmp_path / "a.ply").read_bytes()
    huge = np.float32(60).tobytes()  # exp(60) cannot be squared in float32
    (tmp_path / "a.ply").write_bytes(content[:-20] + huge + content[-16:])
    _, err = converted(tmp_path / "a.ply", tmp_path / "b.spz")
    assert "draw: 1 splat." in err
    assert "4 splats" in err


@pytest.mark.parametrize("ending", ["compressed.ply", "spz", "sog", "splat"])
def test_splats_as_far_as_32_bits_reach_are_compared(tmp_path: Path, ending: str) -> None:
    splats = replace(many_splats(300), origin=np.zeros(3))
    splats.means[5:7] = np.array([[3e38], [-3e38]])
    formats.write(tmp_path / "a.ply", splats)
    result = CliRunner().invoke(
        app, ["convert", *(str(tmp_path / f"{n}") for n in ("a.ply", f"b.{ending}"))]
    )
    assert result.exit_code in (0, 7)
    assert "Unexpected" not in result.stderr


def test_splats_out_of_range_are_counted_and_reported(tmp_path: Path) -> None:
    splats = replace(many_splats(2000), origin=np.zeros(3))
    splats.means[4] = 1e6
    formats.write(tmp_path / "a.ply", splats)
    _, err = converted(tmp_path / "a.ply", tmp_path / "b.spz")
    assert err.count("Warning") == 1
    assert "1 of 2,000 splats moved" in " ".join(err.split())
    out, _ = converted(tmp_path / "a.ply", tmp_path / "b.spz", "--json")
    assert "24 bits" in json.loads(out.splitlines()[-1])["warnings"][0]


def test_one_extreme_colour_does_not_refuse_the_file(tmp_path: Path) -> None:
    splats = many_splats(200)  # one chunk
    splats.sh[7, 0, 0] = 1e20
    formats.write(tmp_path / "a.ply", splats)
    converted(tmp_path / "a.ply", tmp_path / "b.compressed.ply")


def test_outliers_that_coarsen_the_positions_of_a_sog_are_told(tmp_path: Path) -> None:
    splats = replace(many_splats(2000), origin=np.zeros(3))
    splats.sh[:, 1:] = 0
    splats.means[:] *= 5e-4
    splats.log_scales[:] -= 11
    splats.means[4] = 1000
    formats.write(tmp_path / "a.ply", splats)
    _, err = converted(tmp_path / "a.ply", tmp_path / "b.sog")
    text = " ".join(err.split())
    assert err.count("Warning") == 1
    assert "of 2,000 splats moved" in text
    assert "16 bits in the range of all, and 1 outlier widened it" in text
    assert "--drop-floaters" in text


@pytest.mark.parametrize("ending", ["spz", "splat"])
def test_an_origin_that_a_file_cannot_hold_is_reported(tmp_path: Path, ending: str) -> None:
    formats.write(tmp_path / "a.ply", replace(many_splats(30), origin=np.array([5e5, 0, -4])))
    _, err = converted(tmp_path / "a.ply", tmp_path / f"b.{ending}")
    assert err.count("Warning") == 1
    assert f"was written to b.{ending}.offset.json" in " ".join(err.split())
    assert (tmp_path / f"b.{ending}.offset.json").is_file()


def test_it_is_said_whether_a_difference_is_seen(tmp_path: Path) -> None:
    splats = replace(many_splats(300), origin=np.zeros(3))
    formats.write(tmp_path / "a.ply", splats)
    assert "no difference is seen" in converted(tmp_path / "a.ply", tmp_path / "b.quantised.glb")[1]
    for name in ("b.ply", "b.splat"):
        assert "difference is seen" not in converted(tmp_path / "a.ply", tmp_path / name)[1]


def test_a_loss_below_30_db_is_reported_with_its_cause(tmp_path: Path) -> None:
    splats = replace(many_splats(200), origin=np.zeros(3))
    splats.sh[:, 1:] = np.random.default_rng(0).normal(0, 1.5, splats.sh[:, 1:].shape)
    splats.opacity_logits[:] = 3
    formats.write(tmp_path / "a.ply", splats)
    _, err = converted(tmp_path / "a.ply", tmp_path / "b.splat")
    assert err.count("Warning") == 1
    assert "8-bit colours that do not change with the view" in " ".join(err.split())


@pytest.mark.parametrize(
    ("outlier", "cause"),
    [(0.0, "in the range of each 256."), (30.0, "in the range of each 256, and 1 outlier")],
)
def test_positions_off_by_more_than_neighbours_and_sizes_are_reported_with_their_cause(
    tmp_path: Path, outlier: float, cause: str
) -> None:
    splats = replace(many_splats(200), origin=np.zeros(3))
    splats.means[:] = np.random.default_rng(0).normal(0, 1e-4, splats.means.shape)
    splats.means[100:] += 1
    splats.means[7] += outlier
    splats.log_scales[:] = -12
    formats.write(tmp_path / "a.ply", splats)
    _, err = converted(tmp_path / "a.ply", tmp_path / "b.compressed.ply")
    text = " ".join(err.split())
    assert "of 200 splats moved, by up to" in text
    assert cause in text
    assert err.count("Warning") == 1


def test_a_conversion_of_small_loss_has_no_warning(tmp_path: Path) -> None:
    formats.write(tmp_path / "a.ply", replace(many_splats(2000), origin=np.zeros(3)))
    for ending in ("spz", "compressed.ply", "glb"):
        assert "Warning" not in converted(tmp_path / "a.ply", tmp_path / f"b.{ending}")[1]


@pytest.mark.parametrize(("source", "target"), [("a.ply", "b.obj"), ("a.obj", "b.ply")])
def test_unknown_endings_name_the_known_ones(tmp_path: Path, source: str, target: str) -> None:
    formats.write(tmp_path / "a.ply", many_splats(3))
    _, err = converted(tmp_path / source, tmp_path / target, code=2)
    assert ".compressed.ply" in err
    assert not (tmp_path / target).exists()


def test_the_folder_of_the_target_is_made(tmp_path: Path) -> None:
    formats.write(tmp_path / "a.ply", many_splats(3))
    target = tmp_path / "new" / "deep" / "a.spz"
    converted(tmp_path / "a.ply", target)
    assert len(formats.read(target)) == 3


def test_a_missing_or_damaged_file_leaves_nothing_behind(tmp_path: Path) -> None:
    converted(tmp_path / "none.spz", tmp_path / "b.ply", code=3)
    (tmp_path / "a.spz").write_bytes(b"\x1f\x8bnonsense")
    converted(tmp_path / "a.spz", tmp_path / "b.ply", code=3)
    assert not (tmp_path / "b.ply").exists()
    converted(tmp_path / "a.spz", tmp_path / "new" / "b.ply", code=3)
    assert not (tmp_path / "new").exists()


def test_no_splats_are_not_written_as_a_file_of_no_bytes(tmp_path: Path) -> None:
    formats.write(tmp_path / "a.ply", many_splats(0))
    _, err = converted(tmp_path / "a.ply", tmp_path / "b.splat", code=2)
    assert "convert-nothing" in err
    assert not (tmp_path / "b.splat").exists()
    converted(tmp_path / "a.ply", tmp_path / "b.spz")


@pytest.mark.parametrize("ending", ["ply", "spz", "splat", "usda", "usdz", "gltf"])
def test_a_name_too_long_for_the_files_beside_it_is_refused(tmp_path: Path, ending: str) -> None:
    formats.write(tmp_path / "a.ply", replace(many_splats(20), origin=np.array([5e5, 0, -4])))
    for length in (220, 221, 250):
        name = "n" * (length - len(ending) - 1) + f".{ending}"
        _, err = converted(tmp_path / "a.ply", tmp_path / name, code=0 if length == 220 else 3)
        assert ("name-too-long" in err) == (length > 220)
        assert (tmp_path / name).exists() == (length == 220)


@pytest.mark.parametrize("name", ["scan 12:30.gltf", "50% #1?.gltf", "bad\udcff.html"])
def test_an_unusual_name_of_a_file_is_written_and_read(tmp_path: Path, name: str) -> None:
    formats.write(tmp_path / "a.ply", many_splats(20))
    converted(tmp_path / "a.ply", tmp_path / name)
    converted(tmp_path / name, tmp_path / "back.ply")
    assert len(formats.read(tmp_path / "back.ply")) == 20


def test_a_file_is_not_converted_onto_itself(tmp_path: Path) -> None:
    formats.write(tmp_path / "a.ply", many_splats(20))
    before = (tmp_path / "a.ply").read_bytes()
    (tmp_path / "link.ply").symlink_to(tmp_path / "a.ply")
    for target in ("a.ply", "link.ply"):
        assert "target-is-source" in converted(tmp_path / "a.ply", tmp_path / target, code=2)[1]
    assert (tmp_path / "a.ply").read_bytes() == before


@pytest.mark.parametrize("command", [["convert"], ["edit", "--scale", "2"]])
@pytest.mark.parametrize(
    ("taken", "target"),
    [("b.spz", "b.spz"), ("b.bin", "b.gltf"), ("lod-meta.html", "lod-meta.json")],
)
def test_no_clobber_refuses_to_replace_a_file(
    tmp_path: Path, command: list[str], taken: str, target: str
) -> None:
    formats.write(tmp_path / "a.ply", many_splats(20))
    (tmp_path / taken).write_text("mine")
    words = [command[0], str(tmp_path / "a.ply"), str(tmp_path / target), *command[1:]]
    result = CliRunner().invoke(app, [*words, "--no-clobber"])
    assert result.exit_code == 2, result.stderr
    assert "target-exists" in result.stderr
    assert (tmp_path / taken).read_text() == "mine"


@pytest.mark.parametrize("command", [["convert"], ["edit", "--scale", "2"]])
@pytest.mark.parametrize("beside", ["", "{", "[]", '{"buffers": [{"uri": "other.bin"}, {}, 1]}'])
def test_a_gltf_does_not_overwrite_a_bin_that_is_not_its_buffer(
    tmp_path: Path, command: list[str], beside: str
) -> None:
    formats.write(tmp_path / "a.ply", many_splats(20))
    (tmp_path / "points3D.bin").write_text("mine")
    if beside:
        (tmp_path / "points3D.gltf").write_text(beside)
    words = [command[0], str(tmp_path / "a.ply"), str(tmp_path / "points3D.gltf"), *command[1:]]
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 2, result.stderr
    assert "gltf-buffer-taken" in result.stderr
    assert (tmp_path / "points3D.bin").read_text() == "mine"
    assert (tmp_path / "points3D.gltf").exists() == bool(beside)


def test_a_gltf_and_its_own_buffer_are_replaced(tmp_path: Path) -> None:
    target = tmp_path / "a scene%20.gltf"
    for count in (20, 30):
        formats.write(tmp_path / "a.ply", many_splats(count))
        converted(tmp_path / "a.ply", target)
        assert len(formats.read(target)) == count


@pytest.mark.parametrize("name", ["b.gltf", "lod-meta.json"])
def test_a_conversion_that_fails_its_check_leaves_the_earlier_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    formats.write(tmp_path / "a.ply", many_splats(20))
    converted(tmp_path / "a.ply", tmp_path / name)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*.*")}
    formats.write(tmp_path / "a.ply", many_splats(30))
    before[tmp_path / "a.ply"] = (tmp_path / "a.ply").read_bytes()
    monkeypatch.setattr(checks, "read_back", lambda path: 1 / 0)
    assert "convert-verify-failed" in converted(tmp_path / "a.ply", tmp_path / name, code=7)[1]
    assert {path: path.read_bytes() for path in tmp_path.rglob("*.*")} == before


def test_help_names_every_ending() -> None:
    text = help_of("convert")
    for name in formats.FORMATS:
        assert f".{name}" in text


@pytest.mark.parametrize("ending", MESHES)
def test_a_mesh_is_made_from_a_run_and_converted_neither_to_nor_from(
    tmp_path: Path, ending: str
) -> None:
    formats.write(tmp_path / "a.ply", many_splats(20))
    (tmp_path / f"a.{ending}").write_bytes(b"a mesh")
    for source, target in ((f"a.{ending}", "b.ply"), ("a.ply", f"b.{ending}")):
        _, err = converted(tmp_path / source, tmp_path / target, code=2)
        assert f"splat export --format {ending}" in err
        assert "reading" not in err
        assert not (tmp_path / target).exists()


def test_a_folder_in_the_place_of_the_target_is_told(tmp_path: Path) -> None:
    formats.write(tmp_path / "a.ply", many_splats(20))
    (tmp_path / "b.ply").mkdir()
    _, err = converted(tmp_path / "a.ply", tmp_path / "b.ply", code=6)
    assert f"{tmp_path / 'b.ply'} could not be written" in err
    assert len([*tmp_path.iterdir()]) == 2


def test_missing_folders_above_the_target_are_made(tmp_path: Path) -> None:
    formats.write(tmp_path / "a.ply", many_splats(20))
    _, err = converted(tmp_path / "a.ply", tmp_path / "new" / "deep" / "b.ply")
    assert len(formats.read(tmp_path / "new" / "deep" / "b.ply")) == 20
    assert "exact" in err
