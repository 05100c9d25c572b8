"""Tables of the documentation that are made from the code's registries.

python -m tests.docs_tables writes them between `<!-- begin: NAME -->` and `<!-- end -->` of each
page; tests/test_docs.py fails when a page is stale.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from stages.base.settings import settings_of
from stages.run.stages import STAGE_NAMES, STAGE_OF
from tests.layers import LAYERS

ROOT = Path(__file__).parent.parent
PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")))
_BLOCK = re.compile(r"(<!-- begin: ([\w-]+) -->\n).*?(<!-- end -->)", re.S)

Rows = Sequence[tuple[str, ...]]
# What README says of formats: (endings, what they open in, what they keep).
FORMAT_CELLS = (
    (("ply",), "nearly every program that reads splats", "everything, float32"),
    (("splat",), "web viewers", "8-bit colour and rotation; one colour, averaged over the views"),
    (("glb", "gltf"), "viewers with KHR_gaussian_splatting; others show points", "everything"),
    (
        ("usda", "usdc", "usdz"),
        "USD tools with particle fields (OpenUSD 26.03 or newer)",
        "everything",
    ),
    (
        ("quantised.glb",),
        "as `glb`; three.js blends splats of each degree of view dependence by themselves",
        "sizes, rotations and opacities in 16 bits",
    ),
    (
        ("spz.glb",),
        "CesiumJS, and others with KHR_gaussian_splatting_compression_spz_2",
        "as `spz`",
    ),
    (
        ("compressed.ply",),
        "PlayCanvas, SuperSplat, Spark",
        "positions and sizes to 1/1000 of those of 256 neighbours, 8-bit colour",
    ),
    (
        ("spz",),
        "Spark, Open3D, three.js: version 3, which nearly every reader of SPZ knows",
        "sizes to 3 %, 8-bit colour, 4 to 5 bits of view-dependent colour",
    ),
    (
        ("v4.spz",),
        "programs that read SPZ 4: tried with splat-transform, gsply and @adobe/spz",
        "as `spz`; written and read faster",
    ),
    (
        ("sog",),
        "PlayCanvas, SuperSplat, Spark",
        "16-bit positions, 256 sizes and colours, a palette of view-dependent colours",
    ),
    (
        ("lod-meta.json",),
        "PlayCanvas, SuperSplat, which load nearby chunks first",
        "as `sog`, in chunks and levels of detail; written by `splat edit`, `convert`",
    ),
    (
        ("tileset.json",),
        "CesiumJS: 3D Tiles on the globe",
        "as `spz.glb`, in tiles of levels of detail; written by `splat edit`, `convert`",
    ),
    (
        ("html",),
        "any browser, from disk, without a network",
        "everything; also the viewer and the cameras",
    ),
    (("ksplat",), "GaussianSplats3D", "read, not written"),
    (("mesh.glb",), "game engines, mesh tools", "no splats: triangles for collision"),
    (("mesh.ply",), "game engines, mesh tools", "no splats: triangles for collision"),
)


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


def formats() -> str:
    from stages.formats.format_table import BY_ENDING
    from stages.formats.mesh_table import MESHES

    assert [e for endings, _, _ in FORMAT_CELLS for e in endings] == [*BY_ENDING, *MESHES]
    y_up = {row.ending for row in BY_ENDING.values() if row.y_up}
    y_up |= {row.ending for row in MESHES.values() if row.y_up}
    rows: list[tuple[str, ...]] = []
    for endings, opens_in, keeps in FORMAT_CELLS:
        names = ", ".join(f"`{ending}`" for ending in endings)
        rows.append((names, opens_in, f"{keeps}{'; y up' if endings[0] in y_up else ''}"))
    return _table(("`--format`", "opens in", "keeps"), rows)


def format_modules() -> str:
    from stages.formats.codecs import CODECS
    from stages.formats.mesh_files import CODECS_OF_MESHES
    from stages.proof.checks import CHECKS

    rows: list[tuple[str, ...]] = []
    for ending, codec in CODECS.items():
        functions = (codec.write, codec.read, CHECKS[ending].read)
        rows.append((f"`{ending}`", *map(_place, functions)))
    for ending, mesh in CODECS_OF_MESHES.items():
        rows.append((f"`{ending}`", _place(mesh.write), "", _place(mesh.read)))
    return _table(("format", "writer", "reader", "independent reader"), rows)


def _place(function: Any) -> str:
    return f"`{function.__module__.replace('.', '/')}.py` `{function.__qualname__}`"


def cameras() -> str:
    from stages.cameras.camera_formats import CAMERA_FILES

    rows: list[tuple[str, ...]] = []
    for row in CAMERA_FILES:
        points = "yes" if row.read_points else "no"
        module = row.read.__module__.replace(".", "/")
        rows.append((row.description, points, f"`{module}.py`"))
    return _table(("file", "sparse points", "read by"), rows)


def backends() -> str:
    from stages.raster.backends import BACKENDS

    rows: list[tuple[str, ...]] = [("`auto`", "the fastest that runs here")]
    rows += [(f"`{backend.name}`", backend.summary) for backend in BACKENDS]
    return _table(("`--backend`", "is"), rows)


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
