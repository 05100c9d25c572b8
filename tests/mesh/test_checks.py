"""Mesh files, read by programs that did not write them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from plyfile import PlyData
from pygltflib import GLTF2

from stages import formats
from stages.base.errors import SplatError
from stages.formats.mesh_files import CODECS_OF_MESHES
from stages.formats.mesh_table import MESHES
from stages.scene.mesh import Mesh


def tent() -> Mesh:
    """A closed tetrahedron on the ground, its tip two units up (y down: at -2), three ahead."""
    vertices = np.array([[-1, 0, 2], [1, 0, 2], [0, 0, 4], [0, -2, 3.0]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
    colours = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255], [128, 128, 128]], np.uint8)
    mesh = replace(Mesh.of(vertices, faces), colours=colours)
    return replace(mesh, origin=np.array([5e5, 7.0, -4.0]))


def write(path: Path, mesh: Mesh, units: str = "metres") -> str:
    """Write by the table; what the independent reader has to say of it."""
    codec = CODECS_OF_MESHES[path.name.removeprefix("a.")]
    codec.write(path, mesh, units)
    return codec.fault_of(path, mesh)


def test_the_tent_is_closed_and_its_normals_point_out() -> None:
    mesh = tent()
    assert mesh.is_watertight
    assert mesh.normals()[3, 1] < -0.9
    assert trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).volume > 0
    assert not replace(mesh, faces=mesh.faces[:3]).is_watertight
    assert not Mesh.empty().is_watertight


def test_the_glb_stands_upright_for_another_reader(tmp_path: Path) -> None:
    assert write(tmp_path / "a.mesh.glb", tent(), "metres") == ""
    read: Any = trimesh.load(tmp_path / "a.mesh.glb", force="mesh", process=False)
    np.testing.assert_array_equal(read.vertices[3], [0, 2, -3])
    assert read.vertices[:, 1].min() == 0
    assert read.is_watertight
    assert read.volume == pytest.approx(4 / 3)  # positive: outside is still outside
    np.testing.assert_array_equal(read.faces, tent().faces)


def test_the_glb_declares_what_it_is(tmp_path: Path) -> None:
    assert write(tmp_path / "a.mesh.glb", tent(), "arbitrary") == ""
    document = GLTF2().load(str(tmp_path / "a.mesh.glb"))
    assert "collision proxy" in document.asset.generator
    assert "collision proxy" in document.asset.extras["note"]
    assert document.asset.extras["units"] == "arbitrary"
    assert document.asset.extras["splat_origin"] == [5e5, -7, 4]
    attributes = document.meshes[0].primitives[0].attributes
    place = document.accessors[attributes.POSITION]
    assert (place.min, place.max) == ([-1, 0, -4], [1, 2, -2])
    blob, colour = document.binary_blob(), document.accessors[attributes.COLOR_0]
    start = document.bufferViews[colour.bufferView].byteOffset
    levels = np.frombuffer(blob, "<u2", 16, start).reshape(4, 4) / 65535
    # 128 of 255 in sRGB is 0.2159 of the light
    np.testing.assert_allclose(levels[3], [0.2159, 0.2159, 0.2159, 1], atol=1e-4)
    np.testing.assert_array_equal(levels[0], [1, 0, 0, 1])


def test_the_ply_lies_where_the_splats_do(tmp_path: Path) -> None:
    assert write(tmp_path / "a.mesh.ply", tent(), "metres") == ""
    data = PlyData.read(str(tmp_path / "a.mesh.ply"))
    assert any("collision proxy" in line for line in data.comments)
    assert "units: metres" in data.comments
    assert "splat_origin 500000.0 7.0 -4.0" in data.comments
    assert [float(data["vertex"][axis][3]) for axis in "xyz"] == [0, -2, 3]
    assert [int(data["vertex"][name][2]) for name in ("red", "green", "blue")] == [0, 0, 255]
    read: Any = trimesh.load(tmp_path / "a.mesh.ply", process=False)
    assert read.volume == pytest.approx(4 / 3)


@pytest.mark.parametrize("name", MESHES)
def test_equal_meshes_give_equal_bytes(tmp_path: Path, name: str) -> None:
    contents = []
    for _ in range(2):
        write(tmp_path / f"a.{name}", tent())
        contents.append((tmp_path / f"a.{name}").read_bytes())
    assert contents[0] == contents[1]


def test_an_empty_mesh_is_a_whole_file(tmp_path: Path) -> None:
    assert [write(tmp_path / f"a.{name}", Mesh.empty()) for name in MESHES] == ["", ""]
    assert len(PlyData.read(str(tmp_path / "a.mesh.ply"))["face"].data) == 0
    assert GLTF2().load(str(tmp_path / "a.mesh.glb")).meshes == []


@pytest.mark.parametrize("name", MESHES)
@pytest.mark.parametrize("damage", ["inside out", "on its head", "a face short", "cut short"])
def test_a_wrong_file_is_seen(tmp_path: Path, name: str, damage: str) -> None:
    path, mesh = tmp_path / f"a.{name}", tent()
    if damage == "inside out":
        mesh = replace(mesh, faces=mesh.faces[:, ::-1])
    elif damage == "on its head":
        mesh = replace(mesh, vertices=mesh.vertices * np.array([1, -1, -1], np.float32))
    elif damage == "a face short":
        mesh = replace(mesh, faces=mesh.faces[:-1])
    write(path, mesh)
    if damage == "cut short":
        path.write_bytes(path.read_bytes()[:-7])
    assert CODECS_OF_MESHES[name].fault_of(path, tent())


@pytest.mark.parametrize("name", MESHES)
def test_a_mesh_is_not_read_as_splats_under_any_name(tmp_path: Path, name: str) -> None:
    write(tmp_path / f"a.{name}", tent())
    renamed = (tmp_path / f"a.{name}").rename(tmp_path / f"a{Path(name).suffix}")
    with pytest.raises(SplatError, match=r"it is a mesh.*not splats") as caught:
        formats.read(renamed)
    assert caught.value.code == "splats-unreadable"
