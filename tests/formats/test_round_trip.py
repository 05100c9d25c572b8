"""Writing and reading again, for our own readers; and what other programs' files look like."""

from __future__ import annotations

import json
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stages import formats
from stages.formats import splat32
from stages.formats.ply import property_names
from tests.formats.files import edited_glb, ply_bytes, read
from tests.formats.truth import extreme_splats, many_splats, red_splat

EXACT = [name for name, row in formats.FORMATS.items() if not row.loses]


def unit(quaternions: np.ndarray) -> np.ndarray:
    return quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)


def test_usd_is_read_in_another_process_with_the_same_result(tmp_path: Path) -> None:
    formats.write(tmp_path / "a [1].usdz", many_splats())
    np.testing.assert_array_equal(formats.read(tmp_path / "a [1].usdz").sh, many_splats().sh)


@pytest.mark.parametrize("suffix", EXACT)
def test_splats_come_back_from_every_format(tmp_path: Path, suffix: str) -> None:
    splats = many_splats()
    assert formats.write(tmp_path / f"a.{suffix}", splats) == 0
    back, wanted = read(tmp_path / f"a.{suffix}"), splats
    np.testing.assert_array_equal(back.means, wanted.means)
    np.testing.assert_array_equal(back.sh, wanted.sh)
    np.testing.assert_array_equal(back.sh_degrees, wanted.sh_degrees)
    np.testing.assert_array_equal(back.origin, wanted.origin)
    np.testing.assert_allclose(back.log_scales, wanted.log_scales, atol=1e-6)
    np.testing.assert_allclose(back.opacity_logits, wanted.opacity_logits, atol=1e-3)
    np.testing.assert_allclose(unit(back.quaternions), unit(wanted.quaternions), atol=1e-6)


@pytest.mark.parametrize("suffix", formats.FORMATS)
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_every_degree_keeps_its_colours(tmp_path: Path, suffix: str, degree: int) -> None:
    splats = many_splats().with_sh_degree(degree)
    formats.write(tmp_path / f"a.{suffix}", splats)
    back = read(tmp_path / f"a.{suffix}")
    assert back.sh_degree == min(degree, formats.FORMATS[suffix].sh_degree)
    assert len(back) == len(splats)


@pytest.mark.parametrize("suffix", formats.FORMATS)
def test_equal_splats_give_equal_bytes(
    tmp_path: Path, suffix: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    import time

    path = tmp_path / f"a.{suffix}"
    contents = []
    for zone in ("UTC", "Asia/Kathmandu"):
        monkeypatch.setenv("TZ", zone)
        time.tzset()
        formats.write(path, many_splats())
        contents.append([file.read_bytes() for file in sorted(tmp_path.iterdir())])
    monkeypatch.undo()
    time.tzset()
    assert contents[0] == contents[1]


def test_splat32_loses_what_8_bits_lose_and_no_more(tmp_path: Path) -> None:
    splats = many_splats()
    wanted = splats.take(splat32.order(splats))
    formats.write(tmp_path / "a.splat", splats)
    back = read(tmp_path / "a.splat")
    np.testing.assert_array_equal(back.means, wanted.means)
    np.testing.assert_allclose(back.log_scales, wanted.log_scales, atol=1e-6)
    np.testing.assert_allclose(back.opacities, wanted.opacities, atol=0.5 / 255 + 1e-6)
    rgb = np.clip(0.5 + 0.2820948 * wanted.sh[:, 0], 0, 1)
    np.testing.assert_allclose(0.5 + 0.2820948 * back.sh[:, 0], rgb, atol=0.5 / 255 + 1e-6)
    cosine = np.abs((unit(back.quaternions) * unit(wanted.quaternions)).sum(axis=1))
    assert np.degrees(2 * np.arccos(np.minimum(cosine, 1))).max() < 1.0


@pytest.mark.parametrize("suffix", formats.FORMATS)
def test_what_cannot_be_drawn_is_left_out_and_counted(tmp_path: Path, suffix: str) -> None:
    splats = many_splats(12)
    splats.means[0, 1] = np.nan
    splats.log_scales[2, 0] = np.inf
    splats.log_scales[3, 0] = 60.0
    splats.quaternions[5] = 0
    splats.opacity_logits[7] = np.nan
    splats.sh[8, 0, 0] = -np.inf
    assert formats.write(tmp_path / f"a.{suffix}", splats) == 6
    assert len(read(tmp_path / f"a.{suffix}")) == 6


@pytest.mark.parametrize("suffix", [*EXACT, "splat"])
def test_valid_extremes_stay(tmp_path: Path, suffix: str) -> None:
    splats = extreme_splats(0)
    assert formats.write(tmp_path / f"a.{suffix}", splats) == 0
    back = read(tmp_path / f"a.{suffix}")
    if suffix == "splat":
        wanted = splats.take(splat32.order(splats))
    else:
        wanted = splats
    np.testing.assert_array_equal(back.means, wanted.means)
    np.testing.assert_allclose(
        np.maximum(back.log_scales, -87), np.maximum(wanted.log_scales, -87), atol=1e-5
    )
    step = 0.5 / 255 if suffix == "splat" else 1e-6
    np.testing.assert_allclose(back.opacities, wanted.opacities, atol=step + 1e-6)
    if suffix != "splat":
        wanted_unit = unit(wanted.quaternions.astype(np.float64))
        got = unit(back.quaternions.astype(np.float64))
        np.testing.assert_allclose(np.abs((got * wanted_unit).sum(axis=1)), 1, atol=1e-6)


@pytest.mark.parametrize("suffix", [name for name in formats.FORMATS if name != "splat"])
def test_no_splats_are_a_valid_file(tmp_path: Path, suffix: str) -> None:
    formats.write(tmp_path / f"a.{suffix}", many_splats(4).take(np.zeros(4, bool)))
    assert len(read(tmp_path / f"a.{suffix}")) == 0


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("kind", ["float", "double"])
def test_a_ply_of_any_order_encoding_and_type_reads_the_same(
    tmp_path: Path, encoding: str, kind: str
) -> None:
    splats = many_splats(30)
    names = [name for name in property_names(3) if name[0] != "n"] + ["segment", "nx"]
    np.random.default_rng(3).shuffle(names)
    (tmp_path / "a.ply").write_bytes(ply_bytes(splats, names, encoding, kind))
    back = read(tmp_path / "a.ply")
    for field in ("means", "quaternions", "log_scales", "opacity_logits", "sh", "sh_degrees"):
        np.testing.assert_array_equal(getattr(back, field), getattr(splats, field))


def test_a_ply_with_windows_line_ends_reads_the_same(tmp_path: Path) -> None:
    formats.write(tmp_path / "a.ply", red_splat())
    head, body = (tmp_path / "a.ply").read_bytes().split(b"end_header\n", 1)
    (tmp_path / "a.ply").write_bytes(head.replace(b"\n", b"\r\n") + b"end_header\r\n" + body)
    np.testing.assert_array_equal(read(tmp_path / "a.ply").sh, red_splat().sh)


def test_opaque_and_flat_splats_of_other_programs_are_read(tmp_path: Path) -> None:
    splats = many_splats(3)
    splats.opacity_logits[0] = np.inf
    splats.opacity_logits[1] = -np.inf
    splats.log_scales[2, 1] = -np.inf
    data = ply_bytes(splats, property_names(3), "binary_little_endian", "float")
    (tmp_path / "a.ply").write_bytes(data)
    back = read(tmp_path / "a.ply")
    np.testing.assert_allclose(back.opacities[:2], [1, 0], atol=1e-6)
    assert np.isfinite(back.log_scales).all()


def test_a_gltf_node_may_move_and_scale_its_splats(tmp_path: Path) -> None:
    path = tmp_path / "a.glb"
    formats.write(path, red_splat())

    def edit(document: dict[str, Any]) -> None:
        document["nodes"][0] |= {"translation": [10, 20, 30], "scale": [2, 2, 2]}
        document["nodes"].append({"children": [0], "translation": [0, 0, 1]})
        document["scenes"] = [{"nodes": [1]}]

    edited_glb(path, edit)
    back = formats.read(path)
    # (1, -2, -3) x 2 + (10, 20, 31) = (12, 16, 25) in y up
    np.testing.assert_allclose(back.means, [[12, -16, -25]])
    np.testing.assert_allclose(np.exp(back.log_scales), [[0.2, 0.4, 0.8]], rtol=1e-6)


def test_a_gltf_with_an_empty_list_of_compressions_is_not_compressed(tmp_path: Path) -> None:
    path = tmp_path / "a.glb"
    formats.write(path, red_splat())

    def edit(document: dict[str, Any]) -> None:
        primitive = document["meshes"][0]["primitives"][0]
        primitive["extensions"]["KHR_gaussian_splatting"]["extensions"] = {}

    edited_glb(path, edit)
    np.testing.assert_array_equal(formats.read(path).means, red_splat().means)


def test_gltf_integers_are_decoded_as_the_specification_says(tmp_path: Path) -> None:
    path = tmp_path / "a.glb"
    formats.write(path, red_splat())
    opacity = np.array([191], np.uint8).tobytes() + b"\0\0\0"
    rotation = np.array([32767, 0, 0, -32768], "<i2").tobytes()
    scale = np.array([1, 2, 3], "<u2").tobytes() + b"\0\0"
    content = path.read_bytes()
    size = struct.unpack_from("<I", content, 12)[0]
    floats = content[28 + size :]

    def edit(document: dict[str, Any]) -> None:
        names = document["meshes"][0]["primitives"][0]["attributes"]
        offset = len(floats)
        document["buffers"][0]["byteLength"] = offset + 20
        for name, kind, length, whole in (
            ("OPACITY", 5121, 4, False),
            ("ROTATION", 5122, 8, False),
            ("SCALE", 5123, 8, True),
        ):
            accessor = document["accessors"][names[f"KHR_gaussian_splatting:{name}"]]
            accessor |= {"componentType": kind, "normalized": not whole}
            view = document["bufferViews"][accessor["bufferView"]]
            view |= {"byteOffset": offset, "byteLength": length}
            offset += length

    edited_glb(path, edit, floats + opacity + rotation + scale)
    back = formats.read(path)
    np.testing.assert_allclose(back.opacities, [191 / 255], atol=1e-6)
    np.testing.assert_allclose(np.exp(back.log_scales), [[1, 2, 3]], rtol=1e-6)
    np.testing.assert_allclose(back.quaternions, [[-1, 1, 0, 0]], atol=1e-6)


def test_interleaved_gltf_attributes_are_read(tmp_path: Path) -> None:
    path = tmp_path / "a.glb"
    splats = replace(many_splats(5).with_sh_degree(0), origin=np.zeros(3))
    formats.write(path, splats)
    content = path.read_bytes()
    size = struct.unpack_from("<I", content, 12)[0]
    document = json.loads(content[20 : 20 + size])
    binary = content[28 + size :]
    # One record a splat: the attributes' own bytes side by side, in the order of the accessors.
    views, n = document["bufferViews"], 5
    columns = [
        np.frombuffer(binary, np.uint8, v["byteLength"], v["byteOffset"]).reshape(n, -1)
        for v in views
    ]
    rows = np.concatenate(columns, axis=1)

    def edit(document: dict[str, Any]) -> None:
        document["bufferViews"] = [
            {"buffer": 0, "byteLength": rows.size, "byteStride": rows.shape[1]}
        ]
        offset = 0
        for accessor, column in zip(document["accessors"], columns, strict=True):
            accessor |= {"bufferView": 0, "byteOffset": offset}
            offset += column.shape[1]

    edited_glb(path, edit, rows.tobytes())
    np.testing.assert_array_equal(formats.read(path).sh, splats.sh)
