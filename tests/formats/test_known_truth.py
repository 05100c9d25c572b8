"""What each file must hold for one splat known by hand, read by parsers that we did not write.

Reading back with our own reader cannot show a wrong quaternion order or interleaved f_rest: the
reader would make the same mistake. Here every number is compared with the format's own rules.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from stages import formats
from stages.proof.checks import read_back
from tests.formats.files import glb_parts
from tests.formats.truth import (
    C0,
    MEAN,
    OPACITY,
    QUATERNION,
    RED,
    SCALES,
    colour,
    covariance,
    many_splats,
    red_splat,
)

F = np.diag([1.0, -1.0, -1.0])
W, X, Y, Z = QUATERNION
TURNED_COVARIANCE = F @ covariance(QUATERNION, SCALES) @ F
TURNED_MEAN = F @ MEAN
LOOKING = np.array([0.3, -0.8, 0.5])

# (of the covariance's elements, of the colour): what each rounds. A step of SH is 1/32 in a packed
# .ply; three of them and C1 make half a step 0.023 at most.
# Quantised glTF: of 0.4 in steps of 0.5 / 65535, and of rotations in steps of 1 / 32767.
# SPZ: sizes by 1/32, so squares of 0.4 by 0.01; SH of degree 1 by 1/32, which C1 halves thrice.
# SOG: 8 bits of each component of a rotation; of one splat the codebooks hold every number.
LOSSES = {
    "splat": (1e-3, 2e-3),
    "quantised.glb": (1e-5, 1e-6),
    "compressed.ply": (1e-3, 0.023),
    "spz": (6e-3, 0.04),
    "v4.spz": (6e-3, 0.04),
    "spz.glb": (6e-3, 0.04),
    "sog": (2e-3, 1e-6),
}


def test_ply_rows_follow_the_reference_layout(tmp_path: Path) -> None:
    from plyfile import PlyData

    formats.write(tmp_path / "a.ply", red_splat())
    vertex = PlyData.read(str(tmp_path / "a.ply"))["vertex"]
    assert [p.name for p in vertex.properties] == [
        *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"),
        *(f"f_rest_{i}" for i in range(9)),
        *("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
    ]
    assert {p.val_dtype for p in vertex.properties} == {"f4"}
    row = np.array(vertex.data[0].tolist())
    np.testing.assert_allclose(row[:6], [1, 2, 3, 0, 0, 0])
    np.testing.assert_allclose(row[6:9], (RED - 0.5) / C0, rtol=1e-6)
    # All of red (m = -1, 0, 1), then green, then blue.
    np.testing.assert_allclose(row[9:18], [0, 0.1, 0, -0.3, 0, 0, 0, 0, 0.2], rtol=1e-6)
    np.testing.assert_allclose(row[18], np.log(3), rtol=1e-6)
    np.testing.assert_allclose(row[19:22], np.log(SCALES), rtol=1e-6)
    np.testing.assert_allclose(row[22:], [3 * W, 3 * X, 3 * Y, 3 * Z], rtol=1e-6)


def test_ply_holds_its_origin_in_a_comment(tmp_path: Path) -> None:
    from plyfile import PlyData

    formats.write(tmp_path / "a.ply", many_splats(4), units="metres")
    comments = PlyData.read(str(tmp_path / "a.ply")).comments
    assert "splat_origin 4000000.3333333335 -2.0 0.1" in comments
    assert "units: metres" in comments
    assert any("up axis: -y" in comment for comment in comments)


def test_splat_records_are_32_bytes_known_one_by_one(tmp_path: Path) -> None:
    formats.write(tmp_path / "a.splat", red_splat())
    content = (tmp_path / "a.splat").read_bytes()
    assert len(content) == 32
    *floats, r, g, b, a, w, x, y, z = struct.unpack("<6f8B", content)
    np.testing.assert_allclose(floats, [*MEAN, *SCALES], rtol=1e-6)
    assert (g, b, a) == (26, 51, 191)  # 255 x 0.1, 0.2, 0.75
    assert r in (229, 230)  # 255 x 0.9 = 229.5
    # 128 + 128 q; 0.8660 -> 238.85, 1/6 -> 149.33, 1/3 -> 170.67; or all signs changed
    assert (w, x, y, z) in [(239, 149, 171, 171), (17, 107, 85, 85)]


def test_splat_records_come_largest_first(tmp_path: Path) -> None:
    formats.write(tmp_path / "a.splat", many_splats())
    rows = np.frombuffer((tmp_path / "a.splat").read_bytes(), np.float32).reshape(-1, 8)
    alpha = np.frombuffer((tmp_path / "a.splat").read_bytes(), np.uint8).reshape(-1, 32)[:, 27]
    size = rows[:, 3:6].astype(float).prod(axis=1) * alpha
    assert (size[:-1] * (1 + 1e-6) >= size[1:]).all()  # float32 logarithms and their sums
    assert size[0] > 100 * np.median(size) > 0


def test_splat_keeps_an_unrotated_splat_exactly(tmp_path: Path) -> None:
    splats = red_splat()
    splats.quaternions[0] = (1, 0, 0, 0)
    formats.write(tmp_path / "a.splat", splats)
    quaternion = read_back(tmp_path / "a.splat").splats.quaternions[0]
    np.testing.assert_array_equal(np.abs(quaternion), [1, 0, 0, 0])


def accessor(document: dict[str, Any], binary: bytes, index: int) -> NDArray[Any]:
    described = document["accessors"][index]
    view = document["bufferViews"][described["bufferView"]]
    dtype = {5126: "<f4", 5123: "<u2"}[described["componentType"]]
    width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[described["type"]]
    values = np.frombuffer(binary, dtype, described["count"] * width, view["byteOffset"])
    return values.reshape(-1, width)


def test_glb_attributes_are_linear_upright_and_in_the_extensions_order(tmp_path: Path) -> None:
    formats.write(tmp_path / "a.glb", red_splat(), units="metres")
    document, binary = glb_parts(tmp_path / "a.glb")
    assert document["extensionsUsed"] == ["KHR_gaussian_splatting"]
    assert "extensionsRequired" not in document
    assert document["asset"]["version"] == "2.0"
    assert document["asset"]["generator"].startswith("splat ")
    assert document["asset"]["extras"] == {"units": "metres"}
    (primitive,) = document["meshes"][0]["primitives"]
    assert primitive["mode"] == 0
    assert primitive["extensions"]["KHR_gaussian_splatting"] == {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "projection": "perspective",
        "sortingMethod": "cameraDistance",
    }
    values = {
        name.removeprefix("KHR_gaussian_splatting:"): accessor(document, binary, index)[0]
        for name, index in primitive["attributes"].items()
    }
    sh = [f"SH_DEGREE_1_COEF_{i}" for i in range(3)]
    assert set(values) == {
        *("POSITION", "COLOR_0", "ROTATION", "SCALE", "OPACITY", "SH_DEGREE_0_COEF_0"),
        *sh,
    }
    np.testing.assert_allclose(values["POSITION"], [1, -2, -3])
    np.testing.assert_allclose(values["SCALE"], SCALES, rtol=1e-6)
    np.testing.assert_allclose(values["OPACITY"], [OPACITY], rtol=1e-6)
    x, y, z, w = values["ROTATION"]
    assert np.linalg.norm(values["ROTATION"]) == pytest.approx(1, abs=1e-6)
    np.testing.assert_allclose(
        covariance(np.array([w, x, y, z]), values["SCALE"]), TURNED_COVARIANCE, atol=1e-7
    )
    stored = np.array([values["SH_DEGREE_0_COEF_0"], *(values[name] for name in sh)])
    np.testing.assert_allclose(
        colour(stored, F @ LOOKING), colour(red_splat().sh[0], LOOKING), atol=1e-6
    )
    # 0.9, 0.1, 0.2 of sRGB in linear light, and the opacity
    linear = values["COLOR_0"] / 65535
    np.testing.assert_allclose(linear, [0.787412, 0.010023, 0.033105, 0.75], atol=2e-5)
    described = document["accessors"][primitive["attributes"]["POSITION"]]
    assert described["min"] == described["max"] == [1, -2, -3]


def test_glb_is_one_primitive_of_the_highest_degree_in_use(tmp_path: Path) -> None:
    """Viewers sort each primitive by itself: splats that overlap must share one."""
    splats = many_splats()
    formats.write(tmp_path / "a.glb", splats.take(splats.sh_degrees < 3))
    document, _ = glb_parts(tmp_path / "a.glb")
    (primitive,) = document["meshes"][0]["primitives"]
    assert sum("SH_DEGREE" in name for name in primitive["attributes"]) == 9


def test_gltf_names_its_bin_by_a_relative_address(tmp_path: Path) -> None:
    from pygltflib import GLTF2

    formats.write(tmp_path / "my scène.gltf", many_splats())
    document = GLTF2().load(str(tmp_path / "my scène.gltf"))
    assert document is not None
    assert document.buffers[0].uri == "my%20sc%C3%A8ne.bin"
    assert (tmp_path / "my scène.bin").stat().st_size == document.buffers[0].byteLength
    assert len(list(tmp_path.iterdir())) == 2


@pytest.mark.parametrize("suffix", ["usda", "usdc", "usdz"])
def test_usd_attributes_are_all_there_linear_and_upright(tmp_path: Path, suffix: str) -> None:
    from pxr import Usd, UsdGeom, UsdVol

    formats.write(tmp_path / f"a.{suffix}", red_splat())
    stage = Usd.Stage.Open(str(tmp_path / f"a.{suffix}"))
    assert UsdGeom.GetStageUpAxis(stage) == "Y"
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1
    assert stage.GetDefaultPrim()
    assert stage.GetRootLayer().customLayerData["splat"]["units"] == "arbitrary"
    field = UsdVol.ParticleField3DGaussianSplat(stage.GetPrimAtPath("/Scene/Splats"))
    prim = field.GetPrim()
    assert np.allclose(field.GetPositionsAttr().Get()[0], [1, -2, -3])
    np.testing.assert_allclose(field.GetScalesAttr().Get()[0], SCALES, rtol=1e-6)
    assert field.GetOpacitiesAttr().Get()[0] == pytest.approx(OPACITY, rel=1e-6)
    q = field.GetOrientationsAttr().Get()[0]
    assert q.GetLength() == pytest.approx(1, abs=1e-6)
    np.testing.assert_allclose(
        covariance(np.array([q.real, *q.imaginary]), SCALES), TURNED_COVARIANCE, atol=1e-7
    )
    degree = prim.GetAttribute("radiance:sphericalHarmonicsDegree")
    assert degree.HasAuthoredValue()
    assert degree.Get() == 1
    stored = np.array(prim.GetAttribute("radiance:sphericalHarmonicsCoefficients").Get())
    np.testing.assert_allclose(
        colour(stored, F @ LOOKING), colour(red_splat().sh[0], LOOKING), atol=1e-6
    )
    reach = 3 * np.sqrt(np.diag(TURNED_COVARIANCE))
    low, high = np.array(field.GetExtentAttr().Get())
    np.testing.assert_allclose(low, TURNED_MEAN - reach, rtol=1e-5)
    np.testing.assert_allclose(high, TURNED_MEAN + reach, rtol=1e-5)
    assert prim.HasAPI(Usd.ColorSpaceAPI)
    assert Usd.ColorSpaceAPI(prim).GetColorSpaceNameAttr().Get() == "srgb_rec709_scene"


def test_usd_keeps_all_sh_coefficients_of_one_splat_together(tmp_path: Path) -> None:
    from pxr import Usd

    splats = many_splats(5)
    formats.write(tmp_path / "a.usda", splats)
    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    prim = stage.GetPrimAtPath("/Scene/Splats")
    stored = np.array(prim.GetAttribute("radiance:sphericalHarmonicsCoefficients").Get())
    assert stored.shape == (5 * 16, 3)
    np.testing.assert_array_equal(np.abs(stored[32:48]), np.abs(splats.sh[2]))


def test_usdz_packages_pass_the_packaging_rules(tmp_path: Path) -> None:
    import zipfile

    formats.write(tmp_path / "my scène.usdz", red_splat())
    with zipfile.ZipFile(tmp_path / "my scène.usdz") as package:
        (entry,) = package.infolist()
    assert entry.filename == "my_sc_ne.usdc"
    assert entry.compress_type == zipfile.ZIP_STORED
    content = (tmp_path / "my scène.usdz").read_bytes()
    name, extra = struct.unpack_from("<HH", content, entry.header_offset + 26)
    assert (entry.header_offset + 30 + name + extra) % 64 == 0
    assert [p.name for p in tmp_path.iterdir()] == ["my scène.usdz"]


@pytest.mark.parametrize("suffix", formats.FORMATS)
def test_the_independent_reader_finds_the_same_ellipsoids_and_colours(
    tmp_path: Path, suffix: str
) -> None:
    formats.write(tmp_path / f"a.{suffix}", red_splat())
    content = read_back(tmp_path / f"a.{suffix}")
    turn, splats = content.world_from_file[:3, :3], content.splats
    shape_error, colour_error = LOSSES.get(suffix, (1e-6, 1e-6))
    np.testing.assert_allclose(turn @ splats.means[0], MEAN, atol=1e-6)
    np.testing.assert_allclose(
        turn @ covariance(splats.quaternions[0], np.exp(splats.log_scales[0])) @ turn.T,
        covariance(QUATERNION, SCALES),
        atol=shape_error,
    )
    wanted = RED if suffix == "splat" else colour(red_splat().sh[0], LOOKING)
    np.testing.assert_allclose(colour(splats.sh[0], turn.T @ LOOKING), wanted, atol=colour_error)
