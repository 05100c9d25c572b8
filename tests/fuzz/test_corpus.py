"""Inputs that once beat a reader: corpus/LAYER/ holds their files as they were read."""

from __future__ import annotations

import resource
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.fuzz.batch import slug
from tests.fuzz.child import attempt
from tests.fuzz.cost import resident_now_kib
from tests.fuzz.layers import LAYERS

CORPUS = Path(__file__).parent / "corpus"
_LAYERS = {slug(name): layer for name, layer in LAYERS.items()}


@pytest.fixture(autouse=True)
def _limits() -> Iterator[None]:
    before = resource.getrlimit(resource.RLIMIT_CPU)
    yield
    resource.setrlimit(resource.RLIMIT_CPU, before)


@pytest.mark.parametrize(
    "file", sorted(CORPUS.glob("*/*")), ids=lambda file: f"{file.parent.name}/{file.name}"
)
def test_what_once_beat_a_reader_is_refused(tmp_path: Path, file: Path) -> None:
    layer = _LAYERS[file.parent.name]
    layer.content()  # what writing needs is loaded before memory is measured
    for name, content in layer.beside().items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(content)
    path = tmp_path / layer.name
    path.write_bytes(file.read_bytes())
    assert attempt(layer, path, resident_now_kib())[0] == "refused"
