"""Meshes on disk: written, and read back by parsers that did not write them."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.base.errors import Family, SplatError
from stages.surface import gltf, ply
from stages.surface.mesh import Mesh

_Y_UP = np.array([1.0, -1.0, -1.0])  # spelled out here: a wrong turn must not check itself
_WRITERS: dict[str, Callable[[Path, Mesh, str], None]] = {
    "mesh.glb": gltf.write,
    "mesh.ply": ply.write,
}


def write_meshes(
    folder: Path, stem: str, formats: Iterable[str], mesh: Mesh, units: str
) -> list[tuple[str, Path, int]]:
    """`mesh` as `stem`.mesh.glb, `stem`.mesh.ply in `folder`, each read back and compared;
    (format, path, bytes) of each.

    Raises SplatError "export-verify-failed" (family QUALITY), or what keeps a file from being
    written.
    """
    written = []
    for name in formats:
        path = folder / f"{stem}.{name}"
        _WRITERS[name](path, mesh, units)
        _check(path, name, mesh)
        written.append((name, path, path.stat().st_size))
    return written


def _check(path: Path, name: str, mesh: Mesh) -> None:
    try:
        vertices, faces = read_glb(path) if name == "mesh.glb" else read_ply(path)
    except Exception as error:  # whatever another parser raises: the file is wrong
        raise _failed(path, f"another reader refused it ({error})") from error
    if len(vertices) != len(mesh.vertices) or len(faces) != len(mesh.faces):
        raise _failed(path, f"it holds {len(vertices)} vertices and {len(faces)} triangles")
    if not np.array_equal(vertices, mesh.vertices) or not np.array_equal(faces, mesh.faces):
        raise _failed(path, "its vertices or triangles are not those that were written")


def _failed(path: Path, reason: str) -> SplatError:
    return SplatError(
        "export-verify-failed",
        given=f"{path.name} came out wrong: {reason}.",
        wanted="A file that another program reads as the same mesh.",
        hint="Leave this format out with --format, and report this with the run's manifest.",
        family=Family.QUALITY,
    )


def read_ply(path: Path) -> tuple[NDArray[Any], NDArray[Any]]:
    """(vertices [V, 3], faces [F, 3]) by plyfile, in the world's axes."""
    from plyfile import PlyData

    data = PlyData.read(str(path))
    vertices = np.stack([data["vertex"][axis] for axis in "xyz"], axis=1)
    faces = list(data["face"]["vertex_indices"])
    return vertices, np.array(faces, np.int64).reshape(-1, 3)


def read_glb(path: Path) -> tuple[NDArray[Any], NDArray[Any]]:
    """(vertices [V, 3], faces [F, 3]) by pygltflib, turned from y up to the world's axes."""
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
