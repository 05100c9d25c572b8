"""Writes a mesh as .glb: triangles with normals and colours, y up. Specification: glTF 2.0, 3.7."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from stages.formats.gltf import linear_light
from stages.formats.gltf_file import (
    ARRAY_BUFFER,
    Attribute,
    accessor,
    asset,
    buffer_view,
    write_glb,
)
from stages.scene.flip import FLIP, flipped_place
from stages.surface.mesh import NOTE, Mesh

_ELEMENT_ARRAY_BUFFER = 34963
_TRIANGLES = 4


def write(path: Path, mesh: Mesh, units: str) -> None:
    """Write `mesh`. Positions stay relative to `mesh.origin`, which asset.extras holds with the
    place, in the axes of the file. The unit of glTF is the metre; asset.extras says where it is
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
    accessors: list[dict[str, Any]] = []
    views: list[dict[str, Any]] = []
    offset = 0
    for name, attribute in [*attributes.items(), ("", indices)]:
        target = ARRAY_BUFFER if name else _ELEMENT_ARRAY_BUFFER
        accessors.append(accessor(name, attribute, len(views)))
        views.append(buffer_view(attribute, offset, target))
        offset += attribute.rows.nbytes
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
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{}],
    }
