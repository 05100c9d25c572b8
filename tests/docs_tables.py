"""Tables of the documentation that are made from the code's registries.

python -m tests.docs_tables writes them between `<!-- begin: NAME -->` and `<!-- end -->` of each
page; tests/test_docs.py fails when a page is stale.
"""

from __future__ import annotations

import ast
import importlib
import itertools
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from stages.base.settings import settings_of
from stages.run.stages import STAGE_NAMES, STAGE_OF
from tests.layers import LAYERS

if TYPE_CHECKING:
    from stages.formats.mesh_table import MeshFormat
    from stages.formats.table import Format

ROOT = Path(__file__).parent.parent
PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")))
_BLOCK = re.compile(r"(<!-- begin: ([\w-]+) -->\n).*?(<!-- end -->)", re.S)

Rows = Sequence[tuple[str, ...]]


def _table(head: tuple[str, ...], rows: Rows) -> str:
    lines = [head, ("---",) * len(head), *rows]
    return "".join(f"| {' | '.join(cells)} |\n" for cells in lines)


def _summary(path: Path) -> str:
    """The first paragraph of a module's docstring."""
    text = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
    return " ".join(text.split("\n\n")[0].split()).replace("|", r"\|")


def in_reading_order(folder: Path) -> list[Path]:
    """Modules of a package: as the docstring of `__init__` names them, then by name."""
    text = ast.get_docstring(ast.parse((folder / "__init__.py").read_text("utf-8"))) or ""
    named = [name.split(".")[0] for name in re.findall(r"`([\w.]+)`", text)]
    return sorted(
        (path for path in folder.glob("*.py") if path.name != "__init__.py"),
        key=lambda p: (named.index(p.stem) if p.stem in named else len(named), p.stem),
    )


def modules_of(folder: Path) -> str:
    """What a package is, the table of its own modules, and the same for packages inside it."""
    name = folder.relative_to(ROOT).as_posix()
    rows = [(f"`{path.name}`", _summary(path)) for path in in_reading_order(folder)]
    table = _table((f"module of `{name}/`", "contents"), rows)
    below = [path.parent for path in sorted(folder.glob("*/__init__.py"))]
    return "\n".join(
        [f"{_summary(folder / '__init__.py')}\n\n{table}", *(modules_of(path) for path in below)]
    )


def modules() -> str:
    """Tables of all modules, packages in the order of the layers."""
    parts = []
    for number, layer in enumerate(LAYERS):
        for package in (package for package in layer if package != "stages"):
            name = package.replace(".", "/")
            parts.append(f"### `{name}/` (layer {number})\n\n{modules_of(ROOT / name)}")
    return "\n" + "\n".join(parts) + "\n"


def stages() -> str:
    rows: list[tuple[str, ...]] = []
    for number, name in enumerate(STAGE_NAMES, 1):
        stage = STAGE_OF[name]
        rows.append(
            (
                f"`{number}-{name}`",
                f"`stages/{name}/stage.py`",
                ", ".join(stage.reads) or "the photographs",
                str(stage.version),
                ", ".join(f"`{setting.flag}`" for setting in settings_of(stage.settings_type)),
            )
        )
    return _table(("folder", "module", "reads", "version", "options"), rows)


def _formats() -> list[Format | MeshFormat]:
    from stages.formats.mesh_table import MESHES
    from stages.formats.table import TABLE

    return [*TABLE, *MESHES.values()]


def formats() -> str:
    rows: list[tuple[str, ...]] = []
    same = itertools.groupby(_formats(), lambda row: (row.opens_in, row.keeps, row.y_up))
    for (opens_in, keeps, y_up), group in same:
        names = ", ".join(f"`{row.ending}`" for row in group)
        rows.append((names, opens_in, f"{keeps}{'; y up' if y_up else ''}"))
    return _table(("`--format`", "opens in", "keeps"), rows)


def format_modules() -> str:
    from stages.formats.mesh_table import MESHES
    from stages.formats.table import TABLE
    from stages.proof.checks import CHECKS

    rows: list[tuple[str, ...]] = []
    for row in TABLE:
        check = CHECKS[row.ending].read
        places = (row.writer, row.reader, f"{check.__module__}:{check.__qualname__}")
        rows.append((f"`{row.ending}`", *(_place(place) for place in places)))
    for mesh in MESHES.values():
        rows.append((f"`{mesh.ending}`", _place(mesh.writer), "", _place(mesh.independent_reader)))
    return _table(("format", "writer", "reader", "independent reader"), rows)


def _place(text: str) -> str:
    module, _, name = text.partition(":")
    return f"`{module.replace('.', '/')}.py` `{name}`"


def cameras() -> str:
    from stages.cameras.table import CAMERA_FILES

    rows: list[tuple[str, ...]] = []
    for row in CAMERA_FILES:
        module = importlib.import_module(f"stages.cameras.{row.module}")
        points = "yes" if hasattr(module, "read_points") else "no"
        rows.append((row.description, points, f"`stages/cameras/{row.module}.py`"))
    return _table(("file", "sparse points", "read by"), rows)


def backends() -> str:
    from stages.raster.backends import BACKENDS

    rows: list[tuple[str, ...]] = [("`auto`", "the fastest that runs here", "")]
    for backend in BACKENDS:
        devices = ", ".join(f"`{device}`" for device in backend.devices)
        rows.append((f"`{backend.name}`", backend.summary, devices))
    return _table(("`--backend`", "is", "`--device`"), rows)


def presets() -> str:
    from stages.train.settings import PRESETS

    rows: list[tuple[str, ...]] = []
    for name, preset in PRESETS.items():
        cap = f"{preset.max_splats:,}" if preset.max_splats else "by memory and photographs"
        size = f"{preset.train_side} px"
        rows.append((f"`{name}`", f"{preset.steps:,}", size, str(preset.sh_degree), cap))
    return _table(("`--preset`", "steps", "size", "SH degree", "splats, at most"), rows)


def operations() -> str:
    from stages.editing.syntax import OPERATIONS

    rows: list[tuple[str, ...]] = []
    for word in OPERATIONS.values():
        takes = word.takes.replace("|", r"\|")
        rows.append((f"`--{word.name} {takes}".rstrip() + "`", word.help))
    return _table(("operation", "effect"), rows)


def commands() -> str:
    from splatcli.app import ENTRIES

    rows: list[tuple[str, ...]] = []
    for name, entry in ENTRIES.items():
        text = entry.help
        own = ROOT / "splatcli" / "commands" / f"{name}.py"
        rows.append((f"`splat {name}`", text, f"`{own.relative_to(ROOT)}`" if own.exists() else ""))
    return _table(("command", "does", "module besides `splatcli/app.py`"), rows)


def errors() -> str:
    from stages.base.errors import Family

    return _table(
        ("exit status", "family"),
        [(str(int(family)), f"`{family.name}`") for family in Family],
    )


TABLES: dict[str, Callable[[], str]] = {
    "stages": stages,
    "formats": formats,
    "format-modules": format_modules,
    "cameras": cameras,
    "backends": backends,
    "presets": presets,
    "operations": operations,
    "commands": commands,
    "errors": errors,
    "modules": modules,
}


def renewed(text: str) -> str:
    """A page with its tables as the code has them now."""
    return _BLOCK.sub(lambda found: found[1] + TABLES[found[2]]() + found[3], text)


def main() -> None:
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        if renewed(text) != text:
            page.write_text(renewed(text), encoding="utf-8")
            print(f"{page.relative_to(ROOT)} is written anew")


if __name__ == "__main__":
    main()
