"""SPZ in glTF: what is written, and what other programs may write."""

from __future__ import annotations

import gzip
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stages import formats
from stages.base.errors import SplatError
from stages.proof.checks import read_back
from tests.formats.files import edited_glb, glb_parts
from tests.formats.truth import many_splats

SPZ = "KHR_gaussian_splatting_compression_spz_2"
FIELDS = ("means", "quaternions", "log_scales", "opacity_logits", "sh")
Edit = Callable[[dict[str, Any]], None]


def written(tmp_path: Path, count: int = 40, degree: int = 1) -> Path:
    path = tmp_path / "a.spz.glb"
    formats.write(path, many_splats(40).with_sh_degree(degree).take(slice(count)))
    return path


def extension(document: dict[str, Any]) -> dict[str, Any]:
    found = document["meshes"][0]["primitives"][0]["extensions"]["KHR_gaussian_splatting"]
    assert isinstance(found, dict)
    return found


@pytest.mark.parametrize("count", [0, 1, 2, 40])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_it_holds_what_an_spz_holds(tmp_path: Path, count: int, degree: int) -> None:
    path = written(tmp_path, count, degree)
    formats.write(tmp_path / "a.spz", many_splats(40).with_sh_degree(degree).take(slice(count)))
    back, spz = formats.read(path), formats.read(tmp_path / "a.spz")
    assert len(back) == count
    for field in FIELDS:
        np.testing.assert_allclose(getattr(back, field), getattr(spz, field), atol=1e-6)
    np.testing.assert_array_equal(back.origin, many_splats(1).origin)


def test_the_payload_is_an_spz_that_nothing_stands_in_for(tmp_path: Path) -> None:
    document, binary = glb_parts(written(tmp_path))
    assert document["extensionsRequired"] == ["KHR_gaussian_splatting", SPZ]
    assert extension(document)["extensions"] == {SPZ: {"bufferView": 0}}
    (view,) = document["bufferViews"]
    content = gzip.decompress(binary[: view["byteLength"]])
    assert content[:8] == b"NGSP\3\0\0\0"
    assert not any("bufferView" in accessor for accessor in document["accessors"])
    names = document["meshes"][0]["primitives"][0]["attributes"]
    prefix = "KHR_gaussian_splatting:"
    assert [name.removeprefix(prefix) for name in names] == [
        *("POSITION", "COLOR_0", "ROTATION", "SCALE"),
        *(f"SH_DEGREE_1_COEF_{i}" for i in range(3)),
    ]
    positions = document["accessors"][names["POSITION"]]
    held = read_back(tmp_path / "a.spz.glb").splats.means
    np.testing.assert_allclose(positions["min"], held.min(axis=0))
    np.testing.assert_allclose(positions["max"], held.max(axis=0))


def as_cesium_tiles(document: dict[str, Any]) -> None:
    """The extension as in the draft's own example, in a node that is placed."""
    known = extension(document)
    for name in [name for name in known if name != "extensions"]:
        del known[name]
    document["nodes"][0] |= {"translation": [1, 2, 3], "scale": [2, 2, 2]}
    document["asset"] = {"version": "2.0"}


def test_files_of_other_programs_are_read(tmp_path: Path) -> None:
    path = tmp_path / "a.spz.glb"
    formats.write(path, many_splats(40).with_antialias(True))
    before = formats.read(path)
    edited_glb(path, as_cesium_tiles)
    back = formats.read(path)
    assert back.draw_settings.antialias  # the payload says it
    np.testing.assert_allclose(back.means, 2 * before.means + [1, -2, -3], atol=1e-5)
    np.testing.assert_allclose(back.log_scales, before.log_scales + np.log(2), atol=1e-5)


def test_spz_4_is_read_too(tmp_path: Path) -> None:
    path = written(tmp_path)
    formats.write(tmp_path / "a.v4.spz", many_splats(40).with_sh_degree(1))
    payload = (tmp_path / "a.v4.spz").read_bytes()

    def edit(document: dict[str, Any]) -> None:
        document["bufferViews"][0]["byteLength"] = len(payload)
        document["buffers"][0]["byteLength"] = len(payload)

    before = formats.read(path)
    edited_glb(path, edit, payload)
    for field in FIELDS:
        np.testing.assert_array_equal(getattr(formats.read(path), field), getattr(before, field))


def _no_view(document: dict[str, Any]) -> None:
    del extension(document)["extensions"][SPZ]["bufferView"]


def _no_such_view(document: dict[str, Any]) -> None:
    extension(document)["extensions"][SPZ]["bufferView"] = 1


def _not_an_object(document: dict[str, Any]) -> None:
    extension(document)["extensions"][SPZ] = 0


def _long_view(document: dict[str, Any]) -> None:
    document["bufferViews"][0]["byteLength"] += 9


def _short_view(document: dict[str, Any]) -> None:
    document["bufferViews"][0]["byteLength"] -= 9


def _shifted_view(document: dict[str, Any]) -> None:
    document["bufferViews"][0] |= {"byteOffset": 4, "byteLength": 90}


def _cube(document: dict[str, Any]) -> None:
    extension(document)["kernel"] = "cube"


def _shared(document: dict[str, Any]) -> None:
    document["nodes"] = [{"mesh": 0}] * 3
    document["scenes"][0]["nodes"] = [0, 1, 2]


@pytest.mark.parametrize(
    "edit",
    [
        *(_no_view, _no_such_view, _not_an_object, _long_view, _short_view, _shifted_view),
        *(_cube, _shared),
    ],
)
def test_a_file_that_lies_is_refused(tmp_path: Path, edit: Edit) -> None:
    path = written(tmp_path)
    edited_glb(path, edit)
    with pytest.raises(SplatError) as caught:
        formats.read(path)
    assert caught.value.code == "splats-unreadable"


def test_many_views_of_a_payload_that_unpacks_to_much_are_refused(tmp_path: Path) -> None:
    path = written(tmp_path, degree=0)
    payload = gzip.compress(b"NGSP\3\0\0\0" + (250_000).to_bytes(4, "little") + bytes(5_000_004))
    size, times = len(payload), 3

    def edit(document: dict[str, Any]) -> None:
        document["buffers"] = [{"byteLength": size}]
        document["bufferViews"] = [{"buffer": 0, "byteLength": size}] * times
        primitive = document["meshes"][0]["primitives"][0]
        known = extension(document)
        document["meshes"][0]["primitives"] = [
            primitive
            | {
                "extensions": {
                    "KHR_gaussian_splatting": known | {"extensions": {SPZ: {"bufferView": i}}}
                }
            }
            for i in range(times)
        ]

    edited_glb(path, edit, payload)
    with pytest.raises(SplatError, match="declares or unpacks"):
        formats.read(path)
