"""`convert` and `edit` report alike what a file lost: how much, why, and what to do."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from splatcli.app import app
from stages import formats
from stages.formats.codecs import CODECS
from stages.scene import Splats
from tests.formats.truth import many_splats

COMMANDS = [["convert"], ["edit", "--keep", "opacity >= 0"]]


def solid(count: int = 2000) -> Splats:
    splats = replace(many_splats(count), origin=np.zeros(3)).with_sh_degree(0)
    splats.log_scales[:] = np.random.default_rng(0).normal(-2.5, 0.3, (count, 3))
    splats.opacity_logits[:] = 1
    return splats


def warnings_of(folder: Path, splats: Splats, name: str, command: list[str]) -> list[str]:
    formats.write(folder / "a.ply", splats)
    words = [command[0], str(folder / "a.ply"), str(folder / name), *command[1:], "--json"]
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 0, result.stdout
    found: list[str] = json.loads(result.stdout.splitlines()[-1])["warnings"]
    return found


def with_outlier(x: float) -> Splats:
    splats = solid()
    splats.means[7] = (x, 0, 0)
    return splats


def with_sky() -> Splats:
    """A tenth are 2,000 units wide and far away."""
    splats = solid()
    splats.means[::10] *= 1000
    splats.log_scales[::10] = np.log(2000)
    return splats


def with_dust() -> Splats:
    """A third are smaller than the exponential of -20 units, in a scene of such units."""
    splats = solid()
    splats.log_scales[:] -= 16
    splats.log_scales[::3] -= 3.5
    return replace(splats, means=splats.means * np.float32(1e-8))


def gaudy() -> Splats:
    splats = many_splats(500)
    splats.sh[:, 1:] *= 1000
    return replace(splats, origin=np.zeros(3))


@pytest.mark.parametrize("command", COMMANDS, ids=lambda words: words[0])
@pytest.mark.parametrize(
    ("made", "name", "words"),
    [
        (lambda: with_outlier(60_000), "b.compressed.ply", ("moved, by up to", "1 outlier")),
        (lambda: with_outlier(500), "b.compressed.ply", ("moved, by up to 0.1", "1 outlier")),
        (with_sky, "b.spz", ("200 of 2,000", "another size", "5.28", "379 units", "--scale 1e-1")),
        (with_dust, "b.sog", ("of 2,000", "another size", "2.1e-09", "--scale 1e1")),
        (with_dust, "b.compressed.ply", ("of 2,000", "another size", "2.1e-09", "--scale 1e1")),
        (gaudy, "b.spz", ("another colour", "coefficients of view-dependent colour up to 1")),
        (gaudy, "b.compressed.ply", ("another colour", "view-dependent colour up to 4")),
        (gaudy, "lod-meta.json", ("another colour", "a palette of view-dependent colours")),
    ],
)
def test_what_a_writer_changes_is_told_by_both_commands(
    tmp_path: Path,
    made: Callable[[], Splats],
    name: str,
    words: tuple[str, ...],
    command: list[str],
) -> None:
    [warning] = warnings_of(tmp_path, made(), name, command)
    for word in (*words, name, ".ply, .glb and .usdz"):
        assert word in warning


@pytest.mark.parametrize("name", ["b.spz", "b.compressed.ply", "b.sog", "b.splat", "b.ply"])
def test_rounding_that_does_not_show_is_not_told(tmp_path: Path, name: str) -> None:
    assert warnings_of(tmp_path, solid(), name, COMMANDS[0]) == []


def test_one_splat_of_too_small_a_size_does_not_choose_the_scale() -> None:
    splats = with_sky()
    splats.log_scales[3] = -80
    why, advice = CODECS["spz"].size_loss(splats)
    assert "--scale 1e-1" in advice
    splats.log_scales[::10] = 0
    assert CODECS["spz"].size_loss(splats) == (why, "")
    splats.log_scales[:] = -8.5
    splats.log_scales[3] = np.log(600)  # no scale has room for both
    assert CODECS["spz"].size_loss(splats) == (why, "")
    assert CODECS["ply"].size_loss(splats) == ("", "")


@pytest.mark.parametrize("command", COMMANDS, ids=lambda words: words[0])
def test_splats_none_of_which_can_be_drawn_are_refused(tmp_path: Path, command: list[str]) -> None:
    formats.write(tmp_path / "a.splat", replace(solid(3), origin=np.zeros(3)))
    records = np.fromfile(tmp_path / "a.splat", "<f4").reshape(3, 8)
    records[:, 3:6] = 1e30  # the square is no float32
    records.tofile(tmp_path / "a.splat")
    (tmp_path / "b.ply").write_bytes(b"an earlier file")
    words = [command[0], str(tmp_path / "a.splat"), str(tmp_path / "b.ply"), *command[1:]]
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 3
    assert "nothing-drawable" in result.stderr
    assert (tmp_path / "b.ply").read_bytes() == b"an earlier file"


@pytest.mark.parametrize("command", COMMANDS, ids=lambda words: words[0])
@pytest.mark.parametrize("name", ["b.spz", "b.gltf"])
def test_a_file_that_came_out_wrong_replaces_nothing(
    tmp_path: Path, command: list[str], name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    earlier = b'{"buffers": [{"uri": "b.bin"}]}'  # b.bin belongs to it
    kept = {name: earlier, f"{name}.offset.json": b"{}", "b.bin": b"good"}
    for each, content in kept.items():
        (tmp_path / each).write_bytes(content)
    formats.write(tmp_path / "a.ply", solid(50))
    right = formats.write
    monkeypatch.setattr(
        formats, "write", lambda path, splats, **more: right(path, with_outlier(1), **more)
    )
    words = [command[0], str(tmp_path / "a.ply"), str(tmp_path / name), *command[1:]]
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 7
    assert f"{name} came out wrong" in result.stderr
    assert {each: (tmp_path / each).read_bytes() for each in kept} == kept
    assert len([*tmp_path.iterdir()]) == 1 + len(kept)


def test_a_splat_that_lies_elsewhere_is_not_put_down_to_rounding(tmp_path: Path) -> None:
    formats.write(tmp_path / "a.ply", solid())
    formats.write(tmp_path / "b.ply", with_outlier(3))
    words = ["verify", str(tmp_path / "b.ply"), "--against", str(tmp_path / "a.ply")]
    result = CliRunner().invoke(app, words)
    text = " ".join((result.stdout + result.stderr).split())
    assert "1 of 2,000 splats lie elsewhere, by up to 3.54 units" in text
    assert "32 bits" not in text
    assert "hold them" not in text


def small(factor: float) -> Splats:
    splats = solid(200)
    splats.log_scales[:] += np.float32(np.log(factor))
    return replace(splats, means=splats.means * np.float32(factor))


@pytest.mark.parametrize("command", COMMANDS, ids=lambda words: words[0])
def test_a_page_that_blurs_small_splats_says_so(tmp_path: Path, command: list[str]) -> None:
    (warning,) = warnings_of(tmp_path, small(1e-4), "b.html", command)
    assert "blurred" in warning
    scale = warning.partition("--scale ")[2].partition("`")[0]
    assert not warnings_of(tmp_path, small(1e-4 * float(scale)), "c.html", command)
    assert not warnings_of(tmp_path, small(1e-2), "d.html", command)
    assert not warnings_of(tmp_path, small(1e-4), "e.ply", command)
