"""The table of mesh formats: one row for each. Reading it imports nothing.

To add a format, put a function (path, mesh, units) that writes it and an independent reader into
`files`, name both in a row of `MESHES`, and extend the pattern of mesh names in
`stages.formats.table`.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class MeshFormat:
    """One mesh format. Functions are named as "module:function", imported at their first use.

    Attributes:
        ending: what a file's name ends in, without the dot; also the value of `--format`.
        writer: (path, mesh, units) -> None.
        independent_reader: (path) -> (vertices [V, 3], faces [F, 3]) in the world's axes. It shares
            no code with the writer and may raise anything.
        y_up: whether the file's axes are y up, turned 180 degrees about x from ours.
        opens_in, keeps: two cells of README's table.
    """

    ending: str
    writer: str
    independent_reader: str
    y_up: bool = False
    opens_in: str = "game engines, mesh tools"
    keeps: str = "no splats: triangles for collision"


_GLB = MeshFormat(
    "mesh.glb",
    "stages.formats.mesh_files:write_glb_mesh",
    "stages.formats.mesh_files:read_glb",
    True,
)
_PLY = MeshFormat(
    "mesh.ply", "stages.formats.mesh_files:write_ply", "stages.formats.mesh_files:read_ply"
)
MESHES = {row.ending: row for row in (_GLB, _PLY)}
