"""Names between backquotes in docstrings and comments are names that the code has.

A name is a module (full path or its end), an identifier, an option, a command, an error code, a
file of this repository, or a string that the code holds. Other names are in `FOREIGN`.
"""

from __future__ import annotations

import ast
import functools
import importlib
import io
import re
import sys
import tokenize
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
OURS = ("stages", "splatcli")
FILES = {
    path.relative_to(ROOT).as_posix(): path
    for top in OURS
    for path in sorted((ROOT / top).rglob("*.py"))
}
# Names that docstrings may use and our code does not have.
FOREIGN = {
    "numpy.py": "a file of the user's",
    "ru_maxrss": "a field of getrusage(2)",
    "t_00": "a key of Polycam's files, which code makes from row and column",
    "t_23": "a key of Polycam's files, which code makes from row and column",
    ".4-train.partial": "a folder, whose name code makes from the stage's number and name",
    ".4-train.old": "a folder, whose name code makes from the stage's number and name",
}
_PATH = re.compile(r"(?<![\w./*-])((?:[\w-]+/)*[\w-]+\.(?:py|md|toml))(?![\w/])")
_DOTTED = re.compile(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*")


@dataclass
class Names:
    """What one module, or all of them, define and hold.

    Args:
        defined: classes, functions, module-level names and fields, which other modules may name.
        local: parameters, variables, imported names.
        strings: constants; docstrings are left out.
        members: fields and methods by class.
        bases: base classes by class.
    """

    defined: set[str] = field(default_factory=set)
    local: set[str] = field(default_factory=set)
    strings: set[str] = field(default_factory=set)
    members: dict[str, set[str]] = field(default_factory=dict)
    bases: dict[str, set[str]] = field(default_factory=dict)

    def inherited(self, name: str) -> set[str]:
        """Members of a class and of its bases."""
        above = (self.inherited(base) for base in self.bases.get(name, ()) if base != name)
        return self.members.get(name, set()).union(*above)


_SCOPES = ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef


def _targets(body: list[ast.stmt]) -> Iterator[str]:
    """Names that the statements of a module or a class assign."""
    for node in body:
        found: list[ast.expr] = []
        if isinstance(node, ast.Assign):
            found = node.targets
        elif isinstance(node, ast.AnnAssign | ast.AugAssign):
            found = [node.target]
        for target in found:
            yield from (part.id for part in ast.walk(target) if isinstance(part, ast.Name))


def names_of(source: str) -> Names:
    names = Names()
    tree = ast.parse(source)
    docstrings = set()
    names.defined |= set(_targets(tree.body))
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | _SCOPES) and ast.get_docstring(node):
            docstrings.add(node.body[0].value)  # type: ignore[attr-defined]
        if isinstance(node, _SCOPES):
            names.defined.add(node.name)
        if isinstance(node, ast.ClassDef):
            inside = set(_targets(node.body))
            for part in ast.walk(node):
                if isinstance(part, ast.FunctionDef | ast.AsyncFunctionDef):
                    inside.add(part.name)
                elif isinstance(part, ast.Attribute) and isinstance(part.ctx, ast.Store):
                    inside.add(part.attr)
            names.members[node.name] = inside
            names.bases[node.name] = {b.id for b in node.bases if isinstance(b, ast.Name)}
            names.defined |= inside
        elif isinstance(node, ast.Name):
            names.local.add(node.id)
        elif isinstance(node, ast.arg):
            names.local.add(node.arg)
        elif isinstance(node, ast.Attribute):
            names.local.add(node.attr)
        elif isinstance(node, ast.keyword) and node.arg:
            names.local.add(node.arg)
        elif isinstance(node, ast.alias):
            names.local |= {*node.name.split("."), *([node.asname] if node.asname else [])}
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and node not in docstrings:
            if isinstance(node.value, bytes):
                names.strings.add(node.value.decode("latin-1"))
            elif isinstance(node.value, str):
                names.strings.add(node.value)
    return names


@functools.cache
def by_file() -> dict[str, Names]:
    return {name: names_of(path.read_text(encoding="utf-8")) for name, path in FILES.items()}


@functools.cache
def everywhere() -> Names:
    whole = Names()
    for names in by_file().values():
        whole.defined |= {name for name in names.defined if not name.startswith("_")}
        whole.strings |= names.strings
        for name, inside in names.members.items():
            whole.members.setdefault(name, set()).update(inside)
            whole.bases.setdefault(name, set()).update(names.bases[name])
    for name in FILES:
        whole.defined |= set(name.removesuffix(".py").split("/"))
    return whole


@functools.cache
def all_strings() -> str:
    return "\0".join(everywhere().strings)


def modules_of(path: str) -> Iterator[tuple[str, list[str]]]:
    """(file, other parts) for each start of "a.b.c" that ends the path of a module of ours."""
    parts = path.split(".")
    for count in range(len(parts), 0, -1):
        end = "/" + "/".join(parts[:count])
        for name in FILES:
            if f"/{name}".removesuffix(".py").removesuffix("/__init__").endswith(end):
                yield name, parts[count:]


def is_known(name: str, own: str) -> bool:
    """Whether "a", "a.b" or "a.b.c" is a module, or a member of a module, a class or a value."""
    mine, others = by_file()[own], everywhere()
    here = mine.defined | mine.local
    first, *rest = name.split(".")
    if not rest:
        private = name.startswith("_") and not name.startswith("__")
        return name in here or (not private and name in others.defined | others.strings)
    for module, tail in modules_of(name):
        inside = by_file()[module].defined | by_file()[module].local
        if not tail or (tail[0] in inside and set(tail[1:]) <= others.defined):
            return True
    if first in sys.stdlib_module_names:
        return hasattr(importlib.import_module(first), rest[0])
    if first in others.members:
        return rest[0] in others.inherited(first)
    return first in here and set(rest) <= others.defined | mine.local


def known(text: str, own: str) -> bool:
    """Whether the code has what `text` names; own: the file that holds the text."""
    if text in FOREIGN or text.rstrip("/") in everywhere().strings:
        return True
    if _DOTTED.fullmatch(text) and is_known(text, own):
        return True
    if text.startswith("splat "):
        return _command(text)
    if text.startswith(("python -m ", "pytest ")):
        return _shell(text)
    if text.startswith("--"):
        return text.split("=")[0].split()[0] in _options()
    if re.fullmatch(r"[\w./-]+", text) and ((FILES[own].parent / text).exists() or is_file(text)):
        return True
    return (not re.fullmatch(r"[\w-]+", text) and text in all_strings()) or _code(text, own)


@functools.cache
def _options() -> frozenset[str]:
    from splatcli.app import ENTRIES, loaded

    found = {"--help", "--version"}
    for name in ENTRIES:
        for parameter in loaded(name).params:
            found |= {*parameter.opts, *parameter.secondary_opts}
    return frozenset(found) | {text for text in everywhere().strings if text.startswith("--")}


def _command(text: str) -> bool:
    from splatcli.app import ENTRIES

    words = text.split()[1:]
    return (words[0] in ENTRIES or words[0].startswith("--")) and all(
        word.split("=")[0] in _options() for word in words if word.startswith("--")
    )


def _shell(text: str) -> bool:
    words = text.split()
    if words[0] == "pytest":
        return all((ROOT / word).exists() for word in words[1:])
    path = ROOT.joinpath(*words[2].split("."))
    return path.with_suffix(".py").exists() or (path / "__main__.py").exists() or path.is_dir()


def _code(text: str, own: str) -> bool:
    """Whether every name in a piece of Python, or in the head of a function, is known."""
    for source in (text, f"{text}:\n pass", f"def {text}: pass"):
        try:
            tree = ast.parse(source)
        except SyntaxError:
            continue
        nodes = [*ast.walk(tree)]
        found = [ast.unparse(n) for n in nodes if isinstance(n, ast.Name | ast.Attribute)]
        found += [n.arg for n in nodes if isinstance(n, ast.keyword | ast.arg) and n.arg]
        found += [n.name for n in nodes if isinstance(n, ast.FunctionDef)]
        names = [name for name in found if _DOTTED.fullmatch(name)]
        return bool(names) and all(is_known(name, own) for name in names)
    return False


def prose_of(source: str) -> Iterator[tuple[int, str]]:
    """(line, text) of docstrings and of blocks of comments."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Module | _SCOPES) and ast.get_docstring(node):
            first = node.body[0]
            yield first.lineno, first.value.value  # type: ignore[attr-defined]
    last, start = -1, 0
    lines: list[str] = []
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            if token.start[0] != last + 1 and lines:
                yield start, "\n".join(lines)
                lines = []
            start = start if lines else token.start[0]
            last = token.start[0]
            lines.append(token.string.lstrip("# "))
    if lines:
        yield start, "\n".join(lines)


def unknown_names(own: str) -> list[str]:
    """ "file:line: name" of each name between backquotes, and of each path, that is not known."""
    found = []
    for line, text in prose_of(FILES[own].read_text(encoding="utf-8")):
        quoted = (" ".join(name.split()) for name in re.findall(r"`([^`]+)`", text))
        found += [f"{own}:{line}: `{name}`" for name in quoted if not known(name, own)]
        paths = _PATH.findall(re.sub(r"`[^`]+`", "", text))
        found += [f"{own}:{line}: {path}" for path in paths if not is_file(path)]
    return found


@functools.cache
def is_file(path: str) -> bool:
    """Whether a file of the repository has this path, or a path that ends so."""
    tops = ("stages", "splatcli", "tests", "docs")
    return (ROOT / path).exists() or any([*(ROOT / top).rglob(path)] for top in tops)


def test_names_in_docstrings_and_comments_exist() -> None:
    assert not [name for own in FILES for name in unknown_names(own)]


def test_each_foreign_name_is_used() -> None:
    text = "".join(path.read_text(encoding="utf-8") for path in FILES.values())
    assert not [name for name in FOREIGN if f"`{name}`" not in text]


@pytest.mark.parametrize(
    "name",
    [
        *("sfm.seeding", "train.trainer.Loop", "structure.checks", "Splats.colour_of", "--no-such"),
        *("_no_such_helper", "no_such_name", "splat train --no-such", "no/such.py", "np.no_such"),
        *("no-such-code", "time.no_such", "python -m stages.no_such", "means @ no_such"),
    ],
)
def test_an_unknown_name_is_found(name: str) -> None:
    assert not known(name, "stages/train/trainer.py")


@pytest.mark.parametrize(
    "name",
    [
        *("train.trainer", "trainer.Trainer", "stages.train", "Splats.means", "--steps"),
        *("scene.Photo", "splat train --steps 5", "time.monotonic", "train-splat-cap-reached"),
        *("density.py", "training.json"),
    ],
)
def test_a_name_that_the_code_has_is_known(name: str) -> None:
    assert known(name, "stages/train/trainer.py")
