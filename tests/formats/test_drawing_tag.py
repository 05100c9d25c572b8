"""A file says whether its splats are to be drawn with opacity compensation."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Mapping
from pathlib import Path

import pytest

from stages import formats
from stages.base.errors import SplatError
from stages.formats.format_table import ANTIALIASED, AUTO, FORMATS, PLAIN
from stages.proof.losses import losses_of
from stages.proof.prover import Proof, Prover, cameras_for
from tests.scenes import cloud

SAYING = [
    pytest.param(name, marks=[pytest.mark.slow] if name in ("usda", "usdc", "usdz") else [])
    for name, row in FORMATS.items()
    if row.says_drawing
]


def scene(antialias: bool):
    return cloud(300, degree=1, size_px=0.5).with_antialias(antialias)


@pytest.mark.parametrize("antialias", [False, True])
@pytest.mark.parametrize("name", SAYING)
def test_both_readers_find_it(name: str, antialias: bool, tmp_path: Path) -> None:
    path = tmp_path / f"scene.{name}"
    formats.write(path, scene(antialias))
    assert formats.read(path).draw_settings.antialias == antialias
    splats = scene(antialias)
    proof = Prover.of(splats, cameras_for(splats), "cpu").prove(path)
    assert not proof.fault
    assert proof.figures["verify_db"] > 30


def test_a_file_that_says_nothing_is_plain(tmp_path: Path) -> None:
    path = tmp_path / "scene.splat"
    formats.write(path, scene(True))
    assert not formats.read(path).draw_settings.antialias


def retagged(path: Path, old: bytes, new: bytes) -> None:
    content = path.read_bytes()
    assert old in content
    path.write_bytes(content.replace(old, new))


@pytest.mark.parametrize(
    ("comment", "antialias"),
    [
        (b"SplatRenderMode: mip", True),
        (b"splatrendermode: MIP", True),
        (b"SplatRenderMode: default", False),
        (b"antialiased 1", True),
        (b"antialiased 0", False),
        (b"antialiased by somebody", False),
    ],
)
def test_comments_of_other_programs_are_understood(
    comment: bytes, antialias: bool, tmp_path: Path
) -> None:
    path = tmp_path / "scene.ply"
    formats.write(path, scene(True))
    retagged(path, b"SplatRenderMode: mip", comment)
    assert formats.read(path).draw_settings.antialias == antialias


def test_comments_that_contradict_each_other_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "scene.ply"
    formats.write(path, scene(True))
    retagged(path, b"comment SplatRenderMode", b"comment antialiased 0\ncomment SplatRenderMode")
    with pytest.raises(SplatError, match="contradict each other about antialiasing"):
        formats.read(path)


@pytest.mark.parametrize(
    ("tags", "antialias"),
    [({}, False), ({"model": "antialiased"}, True), ({"model": "default"}, False)],
)
def test_a_sog_of_splat_transform_is_understood(
    tags: dict[str, str], antialias: bool, tmp_path: Path
) -> None:
    path = sog_with(tmp_path, tags)
    assert formats.read(path).draw_settings.antialias == antialias


def test_a_sog_that_contradicts_itself_is_refused(tmp_path: Path) -> None:
    path = sog_with(tmp_path, {"antialias": False, "model": "antialiased"})
    with pytest.raises(SplatError, match="antialias and model disagree"):
        formats.read(path)


def sog_with(folder: Path, tags: Mapping[str, object]) -> Path:
    """A .sog that holds these tags only."""
    formats.write(folder / "whole.sog", scene(False))
    path = folder / "scene.sog"
    with zipfile.ZipFile(folder / "whole.sog") as old, zipfile.ZipFile(path, "w") as new:
        for name in old.namelist():
            content = old.read(name)
            if name == "meta.json":
                meta = json.loads(content)
                del meta["antialias"]
                content = json.dumps(meta | tags).encode()
            new.writestr(name, content)
    return path


def test_a_wrong_tag_shows_in_the_proof(tmp_path: Path) -> None:
    path = tmp_path / "scene.ply"
    splats = cloud(300, degree=1, size_px=0.05).with_antialias(True)
    formats.write(path, splats.with_antialias(False))
    proof = Prover.of(splats, cameras_for(splats), "cpu").prove(path)
    assert "drawn again it differs" in proof.fault


def test_the_choice_of_drawing_overrules_the_format() -> None:
    ply, page = FORMATS["ply"], FORMATS["html"]
    assert [row.holds_antialiased(AUTO) for row in (ply, page)] == [False, True]
    assert [row.holds_antialiased(PLAIN) for row in (ply, page)] == [False, False]
    assert [row.holds_antialiased(ANTIALIASED) for row in (ply, page)] == [True, True]


def test_antialiased_splats_in_a_format_for_plain_viewers_are_a_loss() -> None:
    proof = Proof(3, {})
    assert [*losses_of(Path("scene.ply"), scene(True), proof)] == ["drawing"]
    assert not losses_of(Path("scene.ply"), scene(False), proof)
    assert not losses_of(Path("scene.html"), scene(True), proof)
