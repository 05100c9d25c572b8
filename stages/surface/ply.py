"""Writes a mesh as a binary .ply: vertices with normals and colours, triangles. World: y down, as
in the .ply of the splats, so that both coincide."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from stages.base.atomic import replacing
from stages.formats.ply_header import header_text
from stages.surface.mesh import NOTE, Mesh

_VERTEX = np.dtype([("place", "<f4", 3), ("normal", "<f4", 3), ("colour", "u1", 3)])
_FACE = np.dtype([("count", "u1"), ("vertices", "<i4", 3)])


def write(path: Path, mesh: Mesh, units: str) -> None:
    """Write `mesh`. Raises SplatError when the file cannot be written."""
    vertices = np.zeros(len(mesh.vertices), _VERTEX)
    vertices["place"], vertices["normal"] = mesh.vertices, mesh.normals()
    vertices["colour"] = mesh.colours
    faces = np.zeros(len(mesh.faces), _FACE)
    faces["count"], faces["vertices"] = 3, mesh.faces
    with replacing(path) as temporary, temporary.open("wb") as file:
        file.write(_header(mesh, units))
        file.write(vertices.tobytes())
        file.write(faces.tobytes())


def _header(mesh: Mesh, units: str) -> bytes:
    lines = [f"element vertex {len(mesh.vertices)}"]
    lines += [f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz")]
    lines += [f"property uchar {name}" for name in ("red", "green", "blue")]
    lines += [f"element face {len(mesh.faces)}", "property list uchar int vertex_indices"]
    return header_text(units, mesh.origin, mesh.place, lines, NOTE)
