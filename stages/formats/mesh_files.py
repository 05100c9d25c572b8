"""Mesh files: written as binary .ply and as .glb, and checked with independent readers.

.ply: vertices with normals and colours, triangles; y down as in the .ply of the splats, so that
both coincide. .glb: the same, y up. Specification: glTF 2.0, 3.7.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from plyfile import PlyData
from pygltflib import GLTF2

from stages.base.atomic import replacing
from stages.formats.gltf_file import Attribute, asset, buffer_fields, write_glb
from stages.formats.ply_header import header_text
from stages.scene.flip import FLIP, flipped_place
from stages.scene.light import linear_light
from stages.scene.mesh import NOTE, Mesh

_VERTEX = np.dtype([("place", "<f4", 3), ("normal", "<f4", 3), ("colour", "u1", 3)])
_FACE = np.dtype([("count", "u1"), ("vertices", "<i4", 3)])
_TRIANGLES = 4
# Not taken from the writer: its error must not check itself.
_Y_UP = np.array([1.0, -1.0, -1.0])
_Triangles = tuple[NDArray[Any], NDArray[Any]]  # vertices [V, 3], faces [F, 3]


@dataclass(frozen=True)
class MeshCodec:
    """The functions of one mesh format.

    Attributes:
        write: (path, mesh, units).
        read: (path) -> (vertices [V, 3], faces [F, 3]) in the world's axes. It shares no code with
            the writer and may raise anything.
    """

    write: Callable[[Path, Mesh, str], None]
    read: Callable[[Path], _Triangles]

    def fault_of(self, path: Path, mesh: Mesh) -> str:
        """What is wrong with a file that should hold `mesh`, as the independent reader finds it; ""
        if nothing is."""
        try:
            vertices, faces = self.read(path)
        except Exception as error:  # whatever the reader raises: the file is wrong
            return f"another reader refused it ({error})"
        if len(vertices) != len(mesh.vertices) or len(faces) != len(mesh.faces):
            return f"it holds {len(vertices)} vertices and {len(faces)} triangles"
        if not np.array_equal(vertices, mesh.vertices) or not np.array_equal(faces, mesh.faces):
            return "its vertices or triangles are not those that were written"
        return ""


def write_ply(path: Path, mesh: Mesh, units: str) -> None:
    """Write `mesh` as .ply. Raises SplatError when the file cannot be written."""
    vertices = np.zeros(len(mesh.vertices), _VERTEX)
    vertices["place"], vertices["normal"] = mesh.vertices, mesh.normals()
    vertices["colour"] = mesh.colours
    faces = np.zeros(len(mesh.faces), _FACE)
    faces["count"], faces["vertices"] = 3, mesh.faces
    with replacing(path) as temporary, temporary.open("wb") as file:
        file.write(_ply_header(mesh, units))
        file.write(vertices.tobytes())
        file.write(faces.tobytes())


def _ply_header(mesh: Mesh, units: str) -> bytes:
    lines = [f"element vertex {len(mesh.vertices)}"]
    lines += [f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz")]
    lines += [f"property uchar {name}" for name in ("red", "green", "blue")]
    lines += [f"element face {len(mesh.faces)}", "property list uchar int vertex_indices"]
    return header_text(units, mesh.origin, mesh.place, lines, NOTE)


def read_ply(path: Path) -> _Triangles:
    """(vertices [V, 3], faces [F, 3]) by plyfile, in the world's axes."""
    data = PlyData.read(str(path))
    vertices = np.stack([data["vertex"][axis] for axis in "xyz"], axis=1)
    faces = list(data["face"]["vertex_indices"])
    return vertices, np.array(faces, np.int64).reshape(-1, 3)


def write_glb_mesh(path: Path, mesh: Mesh, units: str) -> None:
    """Write `mesh` as .glb. Positions stay relative to `mesh.origin`, which asset.extras holds with
    the place, in the axes of the file. The unit of glTF is the metre; asset.extras says where it is
    "arbitrary".

    Raises SplatError when the file cannot be written."""
    document: dict[str, Any] = {
        "asset": asset(
            units,
            mesh.origin * FLIP + 0.0,
            flipped_place(mesh.place),
            "collision proxy",
            note=NOTE,
        ),
        "scene": 0,
        "scenes": [{"nodes": [0]}],
    }
    if not len(mesh.faces):  # as in formats.gltf: glTF forbids empty lists
        write_glb(path, document | {"scenes": [{"name": "empty"}]}, [])
        return
    attributes = _attributes(mesh)
    indices = Attribute(np.ascontiguousarray(mesh.faces.reshape(-1, 1), "<u4"), 1)
    write_glb(path, document | _described(attributes, indices), [*attributes.values(), indices])


def _attributes(mesh: Mesh) -> dict[str, Attribute]:
    """By name, each vertex a multiple of 4 bytes."""
    flip = FLIP.astype(np.float32)
    # + 0 turns -0 into 0, so that equal positions are equal bytes
    linear = linear_light(mesh.colours / 255.0)
    colours = np.concatenate([linear, np.ones((len(linear), 1))], axis=1)
    return {
        "POSITION": Attribute(np.ascontiguousarray(mesh.vertices * flip + np.float32(0), "<f4"), 3),
        "NORMAL": Attribute(np.ascontiguousarray(mesh.normals() * flip + np.float32(0), "<f4"), 3),
        "COLOR_0": Attribute(np.rint(65535 * colours).astype("<u2"), 4),
    }


def _described(attributes: dict[str, Attribute], indices: Attribute) -> dict[str, Any]:
    primitive = {
        "attributes": {name: i for i, name in enumerate(attributes)},
        "indices": len(attributes),
        "material": 0,
        "mode": _TRIANGLES,
    }
    return {
        "nodes": [{"mesh": 0, "name": "collision proxy"}],
        "meshes": [{"primitives": [primitive], "name": "collision proxy"}],
        "materials": [
            {
                "name": "vertex colours",
                "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0},
                "doubleSided": True,
            }
        ],
        **buffer_fields([*attributes.items(), ("", indices)]),
    }


def read_glb(path: Path) -> _Triangles:
    """(vertices [V, 3], faces [F, 3]) by pygltflib, rotated from y up to the world's axes."""
    document = GLTF2().load(str(path))
    assert document is not None
    if not document.meshes:
        return np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    primitive, blob = document.meshes[0].primitives[0], document.binary_blob()

    def values(index: int, kind: str, width: int) -> NDArray[Any]:
        accessor = document.accessors[index]
        start = document.bufferViews[accessor.bufferView].byteOffset
        return np.frombuffer(blob, kind, accessor.count * width, start)

    vertices = values(primitive.attributes.POSITION, "<f4", 3).reshape(-1, 3) * _Y_UP
    return vertices, values(primitive.indices, "<u4", 1).astype(np.int64).reshape(-1, 3)


CODECS_OF_MESHES = {
    "mesh.glb": MeshCodec(write_glb_mesh, read_glb),
    "mesh.ply": MeshCodec(write_ply, read_ply),
}
