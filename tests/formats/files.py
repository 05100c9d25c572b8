"""Files taken apart and put together by hand, and splats for them."""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages import formats
from stages.formats import usd_read
from stages.scene import Splats
from tests.formats.truth import C0, many_splats


def read(path: Path) -> Splats:
    """As `formats.read`, without the process that it starts for USD: another test has that."""
    return usd_read.parse(path) if path.suffix.startswith(".usd") else formats.read(path)


def ply_bytes(splats: Splats, names: list[str], encoding: str, kind: str) -> bytes:
    """A .ply as other programs write it: columns in any order, of any type."""
    rest = splats.sh[:, 1:].transpose(0, 2, 1).reshape(len(splats), -1)
    known = {
        **{c: splats.means[:, i] for i, c in enumerate("xyz")},
        **{f"f_dc_{i}": splats.sh[:, 0, i] for i in range(3)},
        **{f"f_rest_{i}": rest[:, i] for i in range(rest.shape[1])},
        **{f"scale_{i}": splats.log_scales[:, i] for i in range(3)},
        **{f"rot_{i}": splats.quaternions[:, i] for i in range(4)},
        "opacity": splats.opacity_logits,
    }
    table = np.stack([known.get(name, np.full(len(splats), 7.0)) for name in names], axis=1)
    head = ["ply", f"format {encoding} 1.0", "comment made elsewhere", "element extra 2"]
    head += ["property uchar a", "property short b", f"element vertex {len(splats)}"]
    head += [f"property {kind} {name}" for name in names]
    head += ["element face 1", "property list uchar int vertex_indices", "end_header", ""]
    text = "\n".join(head).encode()
    if encoding == "ascii":
        rows = "".join(" ".join(repr(float(v)) for v in row) + "\n" for row in table)
        return text + b"1 2\n3 4\n" + rows.encode() + b"3 0 1 2\n"
    order = ">" if "big" in encoding else "<"
    return (
        text + b"\1\2\3" * 2 + table.astype(order + {"float": "f4", "double": "f8"}[kind]).tobytes()
    )


def edited_glb(
    path: Path, edit: Callable[[dict[str, Any]], None], binary: bytes | None = None
) -> None:
    """Rewrite a .glb with its JSON changed."""
    content = path.read_bytes()
    size = struct.unpack_from("<I", content, 12)[0]
    document = json.loads(content[20 : 20 + size])
    edit(document)
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    body = content[28 + size :] if binary is None else binary
    head = struct.pack("<4sIII4s", b"glTF", 2, 28 + len(text) + len(body), len(text), b"JSON")
    path.write_bytes(head + text + struct.pack("<I4s", len(body), b"BIN\0") + body)


def glb_parts(path: Path) -> tuple[dict[str, Any], bytes]:
    content = path.read_bytes()
    magic, version, total = struct.unpack_from("<4sII", content)
    assert (magic, version, total) == (b"glTF", 2, len(content))
    size, kind = struct.unpack_from("<I4s", content, 12)
    assert kind == b"JSON"
    assert size % 4 == 0
    document = json.loads(content[20 : 20 + size])
    length, kind = struct.unpack_from("<I4s", content, 20 + size)
    assert kind == b"BIN\0"
    assert length == document["buffers"][0]["byteLength"] == len(content) - 28 - size
    return document, content[28 + size :]


def angles(a: NDArray[np.floating], b: NDArray[np.floating]) -> NDArray[np.float64]:
    """[N] degrees between rotations."""
    a, b = (q / np.linalg.norm(q.astype(np.float64), axis=1, keepdims=True) for q in (a, b))
    return np.degrees(2 * np.arccos(np.minimum(1, np.abs((a * b).sum(axis=1)))))


def three_splats() -> Splats:
    splats = many_splats(3).with_sh_degree(1)
    splats.means[:] = np.array([[0, 0, 0], [0.25, 1.5, 1], [1, 2, 4]])  # in the order of the curve
    splats.log_scales[:] = [[-4, -4, -4], [-3, -2, -1], [0, 0, 0]]
    splats.quaternions[:] = np.array([[2, 0, 0, 0], [0.5, 0.1, -0.7, 0.5], [1, 1, 1, -3]])
    splats.opacity_logits[:] = [0, math.log(3), -math.log(3)]
    splats.sh[:] = 0
    splats.sh[:, 0] = (np.array([[0, 0, 0], [0.5, 0.25, 1], [1, 1, 1]]) - 0.5) / C0
    splats.sh[1, 1:] = [[-5, 0.1, 0.2], [0.3, 0.4, 0.5], [0.6, 0.7, 5]]  # 4 is the limit
    splats.sh_degrees[:] = 1
    return splats
