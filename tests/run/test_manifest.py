"""Manifests survive JSON, and every later change to them is detected."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stages.base.errors import SplatError
from stages.run.digests import FileRecord, combined_digest, differences, record_files
from stages.run.manifest import SCHEMA, json_value, read_sealed, write_sealed

values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
    max_leaves=10,
)


@given(values)
def test_plain_values_survive_json(value: object) -> None:
    once = json_value(value)
    assert json.loads(json.dumps(once, allow_nan=False)) == once


def test_plain_takes_what_stages_report() -> None:
    reported = {
        "psnr_db": np.float32(27.5),
        "count": np.int64(3),
        "list": np.arange(2),
        "path": Path("a"),
        "endless": math.inf,
        1: (True, None),
    }
    assert json_value(reported) == {
        "psnr_db": 27.5,
        "count": 3,
        "list": [0, 1],
        "path": "a",
        "endless": "inf",
        "1": [True, None],
    }


def test_sealed_file_reads_back_and_every_changed_byte_is_noticed(tmp_path: Path) -> None:
    path = tmp_path / "run.json"
    write_sealed(path, {"a": [1, "zwölf", None], "b": {"c": 0.1}})
    assert read_sealed(path) == {"schema": SCHEMA, "a": [1, "zwölf", None], "b": {"c": 0.1}}
    whole = path.read_bytes()
    for i in range(len(whole)):
        broken = bytearray(whole)
        broken[i] ^= 0x01
        path.write_bytes(broken)
        if json_equal(broken, whole):
            continue  # white space
        with pytest.raises(SplatError):
            read_sealed(path)
    for cut in range(len(whole) - 1):
        path.write_bytes(whole[:cut])
        if cut < len(whole.rstrip()):
            with pytest.raises(SplatError):
                read_sealed(path)


def json_equal(a: bytes | bytearray, b: bytes) -> bool:
    try:
        return bool(json.loads(a) == json.loads(b))
    except ValueError:
        return False


def test_missing_file_is_none(tmp_path: Path) -> None:
    assert read_sealed(tmp_path / "nothing.json") is None
    assert not list(tmp_path.iterdir())


def test_digest_depends_on_names_and_bytes_only(tmp_path: Path) -> None:
    for name, files in {
        "one": {"a b/ü.jpg": b"1", "z": b"2"},
        "same": {"z": b"2", "a b/ü.jpg": b"1"},
        "renamed": {"a b/u.jpg": b"1", "z": b"2"},
        "swapped": {"a b/ü.jpg": b"2", "z": b"1"},
        "joined": {"a b/ü.jpg": b"12", "z": b""},
    }.items():
        for file, content in files.items():
            path = tmp_path / name / file
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
    digests = {p.name: combined_digest(record_files(p)) for p in tmp_path.iterdir()}
    assert digests["one"] == digests["same"]
    assert len(set(digests.values())) == 4


def test_differences_are_named_in_order() -> None:
    def record(sha: str) -> FileRecord:
        return FileRecord(sha, 1, 1)

    old = {"b": record("1"), "a": record("1"), "c": record("1")}
    new = {"b": record("2"), "d": record("1"), "c": record("1")}
    assert differences(old, new) == ["a is missing", "b changed", "d is new"]
