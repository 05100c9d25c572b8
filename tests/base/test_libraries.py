"""What splat needs is what its pyproject says, and no second list."""

from __future__ import annotations

import importlib
import tomllib
from pathlib import Path

import pytest

from stages.base import libraries
from stages.base.distribution import NAME, VERSION

PYPROJECT = Path(__file__).parent.parent.parent / "pyproject.toml"


def declared() -> list[str]:
    project = tomllib.loads(PYPROJECT.read_text("utf-8"))["project"]
    return [line.split(">")[0].split("<")[0].split("=")[0] for line in project["dependencies"]]


def test_every_dependency_and_no_extra_is_in_the_manifests_libraries() -> None:
    assert set(libraries.needed()) == set(declared()), (
        "The metadata differ from pyproject.toml: is splat installed as it stands?"
    )
    assert set(libraries.versions()) == {"python", NAME, *declared()}
    assert libraries.versions()[NAME] == VERSION
    assert libraries.versions()["zstandard"][0].isdigit()


def test_pyproject_names_the_distribution_as_the_code_does() -> None:
    project = tomllib.loads(PYPROJECT.read_text("utf-8"))
    assert project["project"]["name"] == NAME
    assert project["project"]["dynamic"] == ["version"]
    version = project["tool"]["setuptools"]["dynamic"]["version"]
    assert version == {"attr": "stages.base.distribution.VERSION"}


def test_dependencies_are_read_less_extras_and_versions(monkeypatch: pytest.MonkeyPatch) -> None:
    lines = ["a.b-c<2,>=1", "usd-core (>=25)", 'x ; python_version < "3"', 'pytest ; extra == "t"']
    monkeypatch.setattr(libraries, "requires", lambda name: lines)
    assert libraries.needed() == ("a.b-c", "usd-core")  # x is for other versions of Python
    monkeypatch.setattr(libraries, "modules_of", lambda name: ("x",))
    assert libraries.needed() == ("a.b-c", "usd-core", "x")


@pytest.mark.parametrize(
    ("name", "module"),
    [
        ("opencv-python-headless", "cv2"),
        ("pillow", "PIL"),
        ("usd-core", "pxr"),
        ("plyfile", "plyfile"),
        ("zstandard", "zstandard"),
    ],
)
def test_what_a_distribution_installs_is_known(name: str, module: str) -> None:
    assert libraries.modules_of(name) == (module,)
    importlib.import_module(module)


def test_every_dependency_has_something_to_import() -> None:
    assert all(libraries.modules_of(name) for name in declared())
    assert libraries.modules_of("no-such-distribution") == ()
