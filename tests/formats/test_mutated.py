"""Packed files with bytes changed, removed and cut off: splats or one clear error, soon."""

from __future__ import annotations

import functools
import gzip
import io
import tempfile
import time
import zipfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from stages import formats
from stages.run.errors import SplatError
from tests.formats.truth import many_splats

LIMIT_S = 5.0  # far above what 40 splats take, on a busy machine too
SLOW_TO_DRAW = [HealthCheck.too_slow, HealthCheck.data_too_large]

# (where, as a fraction of the length; what to write there; how much to leave out after it)
CHANGES = st.lists(
    st.tuples(st.floats(0, 1), st.binary(max_size=8), st.integers(0, 3)), min_size=1, max_size=4
)
CUTS = st.one_of(st.just(1.0), st.floats(0, 1))


def written(suffix: str) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"a.{suffix}"
        formats.write(path, many_splats(40))
        return path.read_bytes()


def changed(content: bytes, changes: list[tuple[float, bytes, int]], cut: float) -> bytes:
    for where, new, removed in changes:
        at = int(where * len(content))
        content = content[:at] + new + content[at + len(new) + removed :]
    return content[: int(cut * len(content))]


def read_or_refused(suffix: str, content: bytes) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"a.{suffix}"
        path.write_bytes(content)
        begun = time.monotonic()
        with suppress(SplatError):
            splats = formats.read(path)
            assert len(splats) <= 1 << 16
            for name in ("means", "quaternions", "log_scales", "opacity_logits", "sh"):
                assert np.isfinite(getattr(splats, name)).all()
        assert time.monotonic() - begun < LIMIT_S


def meta_of(content: bytes) -> bytes:
    with zipfile.ZipFile(io.BytesIO(content)) as package:
        return package.read("meta.json")


@functools.cache
def pictures() -> dict[str, bytes]:
    with zipfile.ZipFile(io.BytesIO(written("sog"))) as package:
        return {name: package.read(name) for name in package.namelist() if name != "meta.json"}


def with_meta(meta: bytes) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as package:
        package.writestr("meta.json", meta)
        for name, content in pictures().items():
            package.writestr(name, content)
    return file.getvalue()


# A changed byte inside gzip is found by its check sum: there the content is changed before packing.
LAYERS: dict[str, tuple[str, Callable[[bytes], bytes], Callable[[bytes], bytes]]] = {
    "compressed.ply": ("compressed.ply", bytes, bytes),
    "spz": ("spz", bytes, bytes),
    "sog": ("sog", bytes, bytes),
    "sog, meta.json": ("sog", meta_of, with_meta),
    "spz, unpacked": ("spz", gzip.decompress, lambda content: gzip.compress(content, 1)),
}


@pytest.mark.parametrize("layer", LAYERS)
def test_a_mutated_file_is_read_or_refused(layer: str) -> None:
    suffix, unpack, pack = LAYERS[layer]
    whole = unpack(written(suffix))

    @settings(max_examples=300, deadline=None, derandomize=True, suppress_health_check=SLOW_TO_DRAW)
    @given(changes=CHANGES, cut=CUTS)
    def check(changes: list[tuple[float, bytes, int]], cut: float) -> None:
        read_or_refused(suffix, pack(changed(whole, changes, cut)))

    check()


@pytest.mark.parametrize("layer", LAYERS)
def test_mutated_heads_are_read_or_refused(layer: str) -> None:
    """Counts, versions and names lie in the first bytes: more of the damage goes there."""
    suffix, unpack, pack = LAYERS[layer]
    whole = unpack(written(suffix))

    @settings(max_examples=300, deadline=None, derandomize=True, suppress_health_check=SLOW_TO_DRAW)
    @given(at=st.integers(0, min(len(whole), 1200)), new=st.binary(min_size=1, max_size=6))
    def check(at: int, new: bytes) -> None:
        read_or_refused(suffix, pack(whole[:at] + new + whole[at + len(new) :]))

    check()
