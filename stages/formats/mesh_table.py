"""The table of mesh formats: one row for each. Reading it imports nothing.

To add a format, put a function (path, mesh, units) that writes it and an independent reader into
`mesh_files` and name both in its `CODECS_OF_MESHES`, add a row to `MESHES`, and extend the pattern
of mesh names in `stages.formats.format_table`.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class MeshFormat:
    """One mesh format.

    Attributes:
        ending: what a file's name ends in, without the dot; also the value of `--format`.
        y_up: whether the file's axes are y up, turned 180 degrees about x from ours.
    """

    ending: str
    y_up: bool = False


MESHES = {row.ending: row for row in (MeshFormat("mesh.glb", y_up=True), MeshFormat("mesh.ply"))}
