"""The formats' own validators have nothing to complain about."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from stages import formats
from tests import scenes
from tests.formats.files import edited_glb
from tests.formats.truth import many_splats
from tests.readers.validators import gltf_complaints, usd_complaints

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("suffix", ["glb", "gltf", "quantised.glb", "spz.glb"])
@pytest.mark.parametrize("degree", [0, 3])
@pytest.mark.usefixtures("packages")
def test_gltf_files_are_valid(tmp_path: Path, suffix: str, degree: int) -> None:
    splats = replace(many_splats(50).with_sh_degree(degree), first_camera=scenes.camera(640, 480))
    formats.write(tmp_path / f"a.{suffix}", splats)
    assert gltf_complaints(tmp_path / f"a.{suffix}") == []


def _bounds(document: dict[str, Any]) -> None:
    index = document["meshes"][0]["primitives"][0]["attributes"]["POSITION"]
    document["accessors"][index]["max"][1] += 1


def _stride(document: dict[str, Any]) -> None:
    del next(view for view in document["bufferViews"] if "byteStride" in view)["byteStride"]


def _misspelt(document: dict[str, Any]) -> None:
    names = document["meshes"][0]["primitives"][0]["attributes"]
    names["KHR_gaussian_splatting:SCALES"] = names.pop("KHR_gaussian_splatting:SCALE")


@pytest.mark.parametrize("damage", [_bounds, _stride, _misspelt])
@pytest.mark.usefixtures("packages")
def test_a_wrong_glb_does_not_pass(
    tmp_path: Path, damage: Callable[[dict[str, Any]], None]
) -> None:
    formats.write(tmp_path / "a.quantised.glb", many_splats(50))
    edited_glb(tmp_path / "a.quantised.glb", damage)
    assert gltf_complaints(tmp_path / "a.quantised.glb")


@pytest.mark.parametrize("suffix", ["usda", "usdc", "usdz"])
def test_usd_files_are_valid(tmp_path: Path, suffix: str) -> None:
    splats = replace(many_splats(50), first_camera=scenes.camera(640, 480))
    formats.write(tmp_path / f"a.{suffix}", splats)
    assert usd_complaints(tmp_path / f"a.{suffix}") == []


def test_a_wrong_usd_file_does_not_pass(tmp_path: Path) -> None:
    formats.write(tmp_path / "a.usda", many_splats(5))
    text = (tmp_path / "a.usda").read_text()
    (tmp_path / "a.usda").write_text(text.replace('upAxis = "Y"', 'doc = "?"'))
    assert usd_complaints(tmp_path / "a.usda")
