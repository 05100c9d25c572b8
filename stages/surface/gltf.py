"""Writes a mesh as .glb: triangles with normals and colours, y up. Specification: glTF 2.0, 3.7."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.formats.gltf import linear_light
from stages.formats.gltf_file import Attribute, accessor, asset, write_glb
from stages.scene.flip import FLIP
from stages.surface.mesh import NOTE, Mesh

_UNSIGNED_INT = 5125
_ARRAY_BUFFER, _ELEMENT_ARRAY_BUFFER = 34962, 34963
_TRIANGLES = 4


def write(path: Path, mesh: Mesh, units: str) -> None:
    """Write `mesh`. Positions stay relative to `mesh.origin`, which asset.extras holds in the axes
    of the file. The unit of glTF is the metre; asset.extras says where it is "arbitrary".

    Raises SplatError when the file cannot be written."""
    document: dict[str, Any] = {
        "asset": asset(units, mesh.origin * FLIP + 0.0, "collision proxy", note=NOTE),
        "scene": 0,
        "scenes": [{"nodes": [0]}],
    }
    if not len(mesh.faces):  # as in formats.gltf: glTF forbids empty lists
        write_glb(path, document | {"scenes": [{"name": "empty"}]}, [], 0)
        return
    arrays = [*_attributes(mesh).values(), np.ascontiguousarray(mesh.faces.ravel(), "<u4")]
    document |= _described(mesh, arrays)
    write_glb(path, document, arrays, sum(array.nbytes for array in arrays))


def _attributes(mesh: Mesh) -> dict[str, NDArray[Any]]:
    """[V, ...] by name, each vertex a multiple of 4 bytes."""
    flip = FLIP.astype(np.float32)
    # + 0 turns -0 into 0, so that equal positions are equal bytes
    linear = linear_light(mesh.colours / 255.0)
    colours = np.concatenate([linear, np.ones((len(linear), 1))], axis=1)
    return {
        "POSITION": np.ascontiguousarray(mesh.vertices * flip + np.float32(0), "<f4"),
        "NORMAL": np.ascontiguousarray(mesh.normals() * flip + np.float32(0), "<f4"),
        "COLOR_0": np.rint(65535 * colours).astype("<u2"),
    }


def _described(mesh: Mesh, arrays: list[NDArray[Any]]) -> dict[str, Any]:
    names = ("POSITION", "NORMAL", "COLOR_0")
    ends = np.cumsum([array.nbytes for array in arrays])
    views = [
        {
            "buffer": 0,
            "byteOffset": int(end) - array.nbytes,
            "byteLength": array.nbytes,
            "target": _ARRAY_BUFFER if array.ndim == 2 else _ELEMENT_ARRAY_BUFFER,
        }
        for array, end in zip(arrays, ends, strict=True)
    ]
    accessors = [
        accessor(name, Attribute(a, a.shape[1]), i)
        for i, (name, a) in enumerate(zip(names, arrays, strict=False))
    ]
    accessors.append(
        {
            "bufferView": len(names),
            "componentType": _UNSIGNED_INT,
            "count": mesh.faces.size,
            "type": "SCALAR",
        }
    )
    primitive = {
        "attributes": {name: i for i, name in enumerate(names)},
        "indices": len(names),
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
