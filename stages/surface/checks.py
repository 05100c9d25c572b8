"""Check of mesh files with independent readers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.base.lazy import load_object
from stages.surface.mesh import Mesh
from stages.surface.table import MeshFormat

# Not taken from the writer: its error must not check itself.
_Y_UP = np.array([1.0, -1.0, -1.0])


def write_checked(path: Path, row: MeshFormat, mesh: Mesh, units: str) -> str:
    """Write the mesh; what is wrong with the file, see `fault_of`."""
    load_object(row.writer)(path, mesh, units)
    return fault_of(path, row, mesh)


def fault_of(path: Path, row: MeshFormat, mesh: Mesh) -> str:
    """What is wrong with a file that should hold `mesh`, as the independent reader finds it; "" if
    nothing is."""
    try:
        vertices, faces = load_object(row.independent_reader)(path)
    except Exception as error:  # whatever the reader raises: the file is wrong
        return f"another reader refused it ({error})"
    if len(vertices) != len(mesh.vertices) or len(faces) != len(mesh.faces):
        return f"it holds {len(vertices)} vertices and {len(faces)} triangles"
    if not np.array_equal(vertices, mesh.vertices) or not np.array_equal(faces, mesh.faces):
        return "its vertices or triangles are not those that were written"
    return ""


def read_ply(path: Path) -> tuple[NDArray[Any], NDArray[Any]]:
    """(vertices [V, 3], faces [F, 3]) by plyfile, in the world's axes."""
    from plyfile import PlyData

    data = PlyData.read(str(path))
    vertices = np.stack([data["vertex"][axis] for axis in "xyz"], axis=1)
    faces = list(data["face"]["vertex_indices"])
    return vertices, np.array(faces, np.int64).reshape(-1, 3)


def read_glb(path: Path) -> tuple[NDArray[Any], NDArray[Any]]:
    """(vertices [V, 3], faces [F, 3]) by pygltflib, rotated from y up to the world's axes."""
    from pygltflib import GLTF2

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
