"""The integers of a quantised .glb, against values known by hand and the rules of glTF."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from stages import formats
from stages.formats import gltf_quantised
from stages.proof.checks import read_back
from tests.formats.files import glb_parts
from tests.formats.truth import MEAN, QUATERNION, many_splats, red_splat

PREFIX = "KHR_gaussian_splatting:"
KINDS = {5121: "u1", 5122: "<i2", 5123: "<u2", 5126: "<f4"}


def raw(document: dict[str, Any], binary: bytes, name: str, primitive: int = 0) -> NDArray[Any]:
    """[N, width]: the stored numbers of an attribute, integers as they are."""
    names = document["meshes"][0]["primitives"][primitive]["attributes"]
    accessor = document["accessors"][names[name]]
    view = document["bufferViews"][accessor["bufferView"]]
    width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
    kind = np.dtype(KINDS[accessor["componentType"]])
    assert accessor.get("normalized", False) == (kind.kind != "f")
    step = view.get("byteStride", width * kind.itemsize)
    rows = np.frombuffer(binary, "u1", accessor["count"] * step, view["byteOffset"])
    return np.ascontiguousarray(rows.reshape(-1, step)[:, : width * kind.itemsize]).view(kind)


def test_integers_are_the_nearest_to_the_values(tmp_path: Path) -> None:
    formats.write(tmp_path / "a.quantised.glb", red_splat())
    document, binary = glb_parts(tmp_path / "a.quantised.glb")
    # The largest scale is 0.4, so the unit is 0.5.
    assert document["nodes"] == [{"mesh": 0, "name": "splats", "scale": [0.5, 0.5, 0.5]}]
    np.testing.assert_array_equal(raw(document, binary, "POSITION"), [[2, -4, -6]])
    np.testing.assert_array_equal(raw(document, binary, PREFIX + "SCALE"), [[13107, 26214, 52428]])
    np.testing.assert_array_equal(raw(document, binary, PREFIX + "OPACITY"), [[49151]])
    w, x, y, z = QUATERNION
    np.testing.assert_array_equal(
        raw(document, binary, PREFIX + "ROTATION"),
        np.rint(32767 * np.array([[x, -y, -z, w]])),
    )
    # 0.787412, 0.010023, 0.033105 of linear light, and 0.75
    np.testing.assert_array_equal(raw(document, binary, "COLOR_0"), [[201, 3, 8, 191]])


def test_splats_without_view_dependence_pay_for_none(tmp_path: Path) -> None:
    splats = many_splats()
    formats.write(tmp_path / "a.quantised.glb", splats)
    document, _ = glb_parts(tmp_path / "a.quantised.glb")
    primitives = document["meshes"][0]["primitives"]
    counts = [sum("SH_DEGREE" in name for name in p["attributes"]) for p in primitives]
    assert counts == [1, 4, 9, 16]
    # 12 + 4 + 8 + 8 + 4 bytes, and 12 for each coefficient
    assert document["buffers"][0]["byteLength"] == 75 * (4 * 36 + 12 * (1 + 4 + 9 + 16))


def test_every_attribute_starts_and_steps_by_multiples_of_4(tmp_path: Path) -> None:
    formats.write(tmp_path / "a.quantised.glb", many_splats(7))
    document, _ = glb_parts(tmp_path / "a.quantised.glb")
    for view in document["bufferViews"]:
        assert view["byteOffset"] % 4 == 0
        assert view["byteLength"] % 4 == 0
        assert view.get("byteStride", 4) % 4 == 0


def test_bounds_are_those_of_the_stored_positions(tmp_path: Path) -> None:
    formats.write(tmp_path / "a.quantised.glb", many_splats())
    document, binary = glb_parts(tmp_path / "a.quantised.glb")
    for number, primitive in enumerate(document["meshes"][0]["primitives"]):
        described = document["accessors"][primitive["attributes"]["POSITION"]]
        stored = raw(document, binary, "POSITION", number)
        np.testing.assert_array_equal(described["min"], stored.min(axis=0))
        np.testing.assert_array_equal(described["max"], stored.max(axis=0))


@pytest.mark.parametrize("reader", ["first", "second"])
def test_both_readers_find_the_splats_within_half_a_step(tmp_path: Path, reader: str) -> None:
    splats = replace(many_splats(), origin=np.zeros(3))
    wanted = splats.take(gltf_quantised.order(splats))
    path = tmp_path / "a.quantised.glb"
    formats.write(path, splats)
    back = formats.read(path) if reader == "first" else read_back(path).splats
    turn = np.ones(3) if reader == "first" else np.array([1, -1, -1])
    np.testing.assert_array_equal(back.means * turn, wanted.means)
    unit = 2.0 ** np.ceil(splats.log_scales.max() / np.log(2))
    scales = np.maximum(np.exp(wanted.log_scales.astype(np.float64)), unit / 65535)
    np.testing.assert_allclose(np.exp(back.log_scales), scales, atol=0.51 * unit / 65535)
    np.testing.assert_allclose(back.opacities, wanted.opacities, atol=0.51 / 65535)
    got, exact = (q.astype(np.float64) for q in (back.quaternions, wanted.quaternions))
    got[:, 1:] *= turn
    exact /= np.linalg.norm(exact, axis=1, keepdims=True)
    np.testing.assert_allclose(got, exact, atol=0.51 / 32767)


def test_a_huge_splat_does_not_take_the_steps_from_all_others(tmp_path: Path) -> None:
    splats = red_splat().take(np.zeros(9, int))
    splats.log_scales[4] = 12.0
    formats.write(tmp_path / "a.quantised.glb", splats)
    document, _ = glb_parts(tmp_path / "a.quantised.glb")
    assert "scale" not in document["nodes"][0]
    back = formats.read(tmp_path / "a.quantised.glb")
    np.testing.assert_allclose(back.log_scales, splats.log_scales, atol=1e-6)
    np.testing.assert_array_equal(back.means[0], MEAN)


def test_a_splat_too_far_for_small_units_leaves_the_positions_as_they_are(tmp_path: Path) -> None:
    splats = red_splat().take(np.zeros(9, int))
    splats.log_scales[:] -= 8.0
    splats.means[4] = 3e38
    formats.write(tmp_path / "a.quantised.glb", splats)
    document, _ = glb_parts(tmp_path / "a.quantised.glb")
    assert "scale" not in document["nodes"][0]
    np.testing.assert_array_equal(formats.read(tmp_path / "a.quantised.glb").means[0], MEAN)
