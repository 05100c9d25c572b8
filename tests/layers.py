"""The layers of packages, and the imports of modules, read from the source: `test_layers` compares
them, `docs_tables` and `docs_picture` show them."""

from __future__ import annotations

import ast
import re
from pathlib import Path

STAGES = ("ingest", "sfm", "seed", "train", "prune", "quantise", "export")

# Lowest first; a module may import from its own layer (but not in a circle) and from those above it
# in this list.
LAYERS: tuple[tuple[str, ...], ...] = (
    ("stages.base", "stages"),
    ("stages.scene",),
    ("stages.raster", "stages.formats", "stages.cameras", "stages.page"),
    ("stages.evaluate",),
    ("stages.ingest",),
    ("stages.sfm",),
    ("stages.seed",),
    ("stages.train",),
    ("stages.prune",),
    ("stages.quantise",),
    ("stages.proof", "stages.mesh"),
    ("stages.export",),
    ("stages.tradeoff", "stages.editing", "stages.viewer", "stages.run"),
    ("stages.distributed",),
    ("splatcli",),
)

ROOT = Path(__file__).parent.parent
OURS = ("stages", "splatcli")


def sources() -> dict[str, Path]:
    """Path by module name."""
    found = {}
    for top in OURS:
        for path in sorted((ROOT / top).rglob("*.py")):
            parts = path.relative_to(ROOT).with_suffix("").parts
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


MODULES = sources()


def imports_of(name: str, source: str, when: str = "ever", strings: bool = True) -> set[str]:
    """Our own modules that `source` imports, by absolute name.

    strings: whether a string that names one of them, with or without ":attribute", counts.

    when: "ever" (anywhere) or "running" (not those for type checkers alone).
    """
    tree = ast.parse(source)
    skipped: set[ast.AST] = set()
    for node in ast.walk(tree):
        typing = isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)
        if isinstance(node, ast.If) and typing and when != "ever":
            skipped |= {child for line in node.body for child in ast.walk(line)}
    found: set[str] = set()
    for node in ast.walk(tree):
        if node in skipped:
            continue
        if strings and isinstance(node, ast.Constant) and isinstance(node.value, str):
            named = re.fullmatch(r"((?:stages|splatcli)(?:\.\w+)+)(?::\w+)?", node.value)
            found |= {named[1]} & MODULES.keys() if named else set()
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{name}: relative imports hide where they lead"
            base = node.module or ""
            for alias in node.names:
                whole = f"{base}.{alias.name}"
                found.add(whole if whole in MODULES else base)
    return {module for module in found if module.split(".")[0] in OURS}


def package_of(module: str) -> str:
    """ "stages.raster" for "stages.raster.cpu.blend"."""
    top = module.split(".")
    return top[0] if top[0] == "splatcli" else ".".join(top[:2])
