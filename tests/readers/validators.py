"""Khronos' glTF validator and OpenUSD's own validators, run on our files."""

from __future__ import annotations

import json
import struct
import tempfile
from pathlib import Path
from typing import Any

from tests.packages import installed, node

HERE = Path(__file__).parent
_PREFIX = "KHR_gaussian_splatting"
# The attributes that the extension names.
SPLAT_ATTRIBUTES = {
    *(f"{_PREFIX}:{name}" for name in ("ROTATION", "SCALE", "OPACITY")),
    *(f"{_PREFIX}:SH_DEGREE_{d}_COEF_{i}" for d in range(4) for i in range(2 * d + 1)),
}


def gltf_complaints(path: Path) -> list[str]:
    """Errors and warnings about a .glb or .gltf, less those that only say that the validator does
    not know the extension; and all of them about the same file without the extension, its
    attributes renamed to what glTF lets anyone add ("_..."). Empty if all is well."""
    found = [message for message in _messages(path) if not _is_ignorance(message)]
    with tempfile.TemporaryDirectory() as folder:
        found += _messages(_shadow(path, Path(folder)))
    return [f"{m['code']} at {m.get('pointer')}: {m['message']}" for m in found]


def _messages(path: Path) -> list[dict[str, Any]]:
    script = HERE / "scripts" / "validate.cjs"
    issues = json.loads(node().run(script, installed(HERE), path))
    assert not issues["truncated"]
    return [message for message in issues["messages"] if message["severity"] <= 1]


def _is_ignorance(message: dict[str, Any]) -> bool:
    """gltf-validator 2.0.0-dev.3.10 takes the extension's own attributes for misspelt ones."""
    name = str(message.get("pointer", "")).rpartition("/")[2]
    return message["code"] == "MESH_PRIMITIVE_INVALID_ATTRIBUTE" and name in SPLAT_ATTRIBUTES


def _shadow(path: Path, folder: Path) -> Path:
    content = path.read_bytes()
    binary = b""
    if path.suffix == ".glb":
        size = struct.unpack_from("<I", content, 12)[0]
        content, binary = content[20 : 20 + size], content[20 + size :]
    document = json.loads(content)
    del document["extensionsUsed"]
    document.pop("extensionsRequired", None)
    for mesh in document["meshes"]:
        for primitive in mesh["primitives"]:
            del primitive["extensions"]
            primitive["attributes"] = {
                "_" + name.replace(":", "_").upper() if name in SPLAT_ATTRIBUTES else name: index
                for name, index in primitive["attributes"].items()
            }
    if path.suffix == ".gltf":
        beside = path.with_suffix(".bin")
        (folder / beside.name).write_bytes(beside.read_bytes())
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    if binary:
        total = 20 + len(text) + len(binary)
        text = struct.pack("<4sIII4s", b"glTF", 2, total, len(text), b"JSON") + text + binary
    shadow = folder / path.name
    shadow.write_bytes(text)
    return shadow


def usd_complaints(path: Path) -> list[str]:
    """What every validator registered in usd-core says about a file. Empty if all is well."""
    from pxr import Usd, UsdValidation

    registry = UsdValidation.ValidationRegistry()
    context = UsdValidation.ValidationContext(registry.GetOrLoadAllValidators())
    return [
        f"{error.GetName()}: {error.GetMessage()}"
        for error in context.Validate(Usd.Stage.Open(str(path)))
    ]
