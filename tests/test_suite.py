"""What holds for the tests themselves."""

from __future__ import annotations

import ast
from pathlib import Path

TESTS = Path(__file__).parent
MODULES = {
    str(path.relative_to(TESTS)): path.read_text(encoding="utf-8")
    for path in sorted(TESTS.rglob("*.py"))
}


def imported_tests(source: str) -> list[str]:
    """Modules of tests that `source` imports from."""
    asked = [
        part
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("tests")
        for part in ((node.module or "").rpartition(".")[2], *(alias.name for alias in node.names))
    ]
    return [part for part in asked if part.startswith("test_")]


def test_helpers_live_in_modules_of_their_own() -> None:
    found = {name: imported_tests(source) for name, source in MODULES.items()}
    assert not {name: asked for name, asked in found.items() if asked}
    assert imported_tests("from tests.viewer.test_page import views") == ["test_page"]
    assert imported_tests("from tests.viewer import test_page") == ["test_page"]


def test_nothing_comes_from_the_path_by_chance() -> None:
    """Programs are named by whoever runs the tests, or come with a package of the test extra."""
    word = "shutil" + ".which"
    # The runs on a device look for the tools of CUDA where they are installed.
    found = [name for name, source in MODULES.items() if word in source]
    assert not [name for name in found if not name.startswith("device/")]
