"""Imports run downward only. They are read from the source: imports inside functions and names of
modules in strings count, too."""

from __future__ import annotations

import ast

import pytest

from tests.layers import LAYERS, MODULES, OURS, ROOT, STAGES, imports_of, package_of


def layer_of(module: str) -> int:
    """The row that names the module's package."""
    rows = [number for number, packages in enumerate(LAYERS) if package_of(module) in packages]
    assert len(rows) == 1, f"{module} has no layer, or several"
    return rows[0]


@pytest.mark.parametrize("name", MODULES)
def test_imports_run_downward_only(name: str) -> None:
    upward = {
        other
        for other in imports_of(name, MODULES[name].read_text(encoding="utf-8"), "running")
        if layer_of(other) > layer_of(name)
    }
    assert not upward, f"{name} imports from a higher layer: {sorted(upward)}"


def left_in_cycles(graph: dict[str, set[str]]) -> set[str]:
    """What remains when everything that imports nothing of the rest is taken away."""
    while True:
        free = {name for name, wanted in graph.items() if not (wanted - {name}) & graph.keys()}
        if not free:
            return set(graph)
        graph = {name: wanted for name, wanted in graph.items() if name not in free}


def test_modules_have_no_cycles_inside_functions_either() -> None:
    """A registry may name modules of its own package that read it: strings do not count here."""
    graph = {
        name: {
            other
            for other in imports_of(name, path.read_text("utf-8"), "running", strings=False)
            if not name.startswith(other + ".")  # a package is loaded before its modules
        }
        for name, path in MODULES.items()
    }
    assert not left_in_cycles(graph)


def test_packages_have_no_cycles_at_all() -> None:
    graph: dict[str, set[str]] = {}
    for name, path in MODULES.items():
        reached = imports_of(name, path.read_text(encoding="utf-8"), "running")
        graph.setdefault(package_of(name), set()).update(map(package_of, reached))
    assert not left_in_cycles(graph)


def test_cycle_is_found() -> None:
    assert left_in_cycles({"a": {"b"}, "b": {"c"}, "c": {"b"}, "d": {"a"}}) == set("abcd")
    assert left_in_cycles({"a": {"b"}, "b": set()}) == set()


def test_no_package_holds_more_than_its_share_of_the_lines() -> None:
    """Vendored files do not count; what a page is made of does."""
    lines: dict[str, int] = {}
    for top in OURS:
        for path in (ROOT / top).rglob("*"):
            if path.suffix in (".py", ".js", ".css", ".html") and "vendor" not in path.parts:
                package = package_of(".".join(path.relative_to(ROOT).with_suffix("").parts))
                lines[package] = lines.get(package, 0) + len(path.read_text("utf-8").splitlines())
    package, most = max(lines.items(), key=lambda item: item[1])
    share = most / sum(lines.values())
    assert share <= 0.15, f"{package} holds {share:.1%} of the lines"


@pytest.mark.parametrize(
    "name", [name for name in MODULES if name.split(".")[1:2] and name.split(".")[1] in STAGES]
)
def test_a_stage_uses_modules_of_earlier_stages_and_never_the_stage_itself(name: str) -> None:
    own = package_of(name)
    others = {f"stages.{stage}.stage" for stage in STAGES} - {f"{own}.stage"}
    assert not imports_of(name, MODULES[name].read_text("utf-8")) & others


def test_nothing_below_imports_the_command() -> None:
    for name, path in MODULES.items():
        if not name.startswith("splatcli"):
            reached = imports_of(name, path.read_text(encoding="utf-8"))
            assert not {m for m in reached if m.startswith("splatcli")}, name


def test_reader_sees_imports_inside_functions() -> None:
    source = "def f():\n    from stages.scene import Camera\n    import stages.raster.draw\n"
    assert imports_of("x", source) == {"stages.scene", "stages.raster.draw"}


def test_reader_sees_names_in_strings() -> None:
    source = 'A = "stages.raster.draw:render"\nB = "stages.scene"\nC = "stages.no.such"\n'
    assert imports_of("x", source) == {"stages.scene", "stages.raster.draw"}
    assert imports_of("x", '"""Says stages.raster.draw."""') == set()


def private_names(source: str) -> set[str]:
    """Names with a leading underscore that `source` takes from another of our modules."""
    tree = ast.parse(source)
    found, modules = set(), set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] in OURS:
            for alias in node.names:
                if f"{node.module}.{alias.name}" in MODULES:
                    modules.add(alias.asname or alias.name)
                elif alias.name.startswith("_"):
                    found.add(alias.name)
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            private = node.attr.startswith("_") and not node.attr.startswith("__")
            if private and node.value.id in modules:
                found.add(node.attr)
    return found


@pytest.mark.parametrize("name", MODULES)
def test_no_module_uses_a_private_name_of_another(name: str) -> None:
    assert not private_names(MODULES[name].read_text("utf-8"))


def test_a_private_name_is_found() -> None:
    assert private_names("from stages.raster.draw import _x as y") == {"_x"}
    assert private_names("from stages.raster import draw\ndraw._x()") == {"_x"}
    assert private_names("from stages.raster import draw\ndraw.x(draw.__doc__)") == set()


# Packages that are imported inside functions, and why; another late import has its reason beside
# it.
LATE = {
    "torch": "takes two seconds and 200 MB, which runs with the CPU kernels do without",
    "triton": "is there on Linux with torch for CUDA only",
    "pxr": "is loaded in processes of its own, or where USD is written",
    "matplotlib": "takes half a second, and is needed at the end of a stage",
    "skimage": "takes half a second, and is needed for a mesh only",
    "flip_evaluator": "needs no more than the views that are compared",
    "av": "holds libraries that a run without videos need not load",
    "pyproj": "comes with the extra `geo`",
    "ray": "comes with the extra `cluster`",
    "fsspec": "comes with the extra `cluster`",
    "filelock": "takes longer than `splat --help` has",
}
MOST_LATE_IMPORTS = 60


def late_imports(source: str) -> list[tuple[int, str, bool]]:
    """(line, top package, whether a comment gives a reason) of imports inside functions."""
    lines, found = source.splitlines(), {}
    for function in ast.walk(ast.parse(source)):
        if not isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        for node in ast.walk(function):
            if isinstance(node, ast.Import | ast.ImportFrom):
                name = node.module if isinstance(node, ast.ImportFrom) else node.names[0].name
                said = "#" in lines[node.lineno - 1] or any(
                    lines[node.lineno - n].strip()[:1] == "#" for n in (2, 3)
                )
                found[node.lineno] = (node.lineno, (name or "").split(".")[0], said)
    return sorted(found.values())


def test_imports_inside_functions_are_few_and_have_their_reasons() -> None:
    late = {name: late_imports(path.read_text("utf-8")) for name, path in MODULES.items()}
    without = [
        (m, line) for m, found in late.items() for line, p, r in found if not r | (p in LATE)
    ]
    assert not without
    assert sum(map(len, late.values())) <= MOST_LATE_IMPORTS
