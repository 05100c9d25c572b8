"""Files of a run folder. "sealed": with a digest that fits, as somebody writes who means harm."""

from __future__ import annotations

import functools
import json
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from stages.base.errors import Family, SplatError
from stages.ingest.capture_file import FILE, load_capture, save_capture
from stages.run.manifest import MANIFEST, Manifest, write_sealed
from stages.run.runfile import RUN_FILE, RunFile
from stages.scene import Capture, Photo, load_splats, save_splats
from stages.scene.storage import FILE_NAME
from stages.train import checkpoint
from stages.train.history import HistoryEntry
from stages.train.optimiser import new_model
from tests.formats.truth import many_splats
from tests.fuzz.layer import SPLATS, Layer

_PICTURES = ("photos/a.jpg", "photos/b.jpg", "photos/c.jpg")


@functools.cache
def _written(write: Callable[[Path], object], name: str) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        write(Path(folder))
        return (Path(folder) / name).read_bytes()


def _splats(folder: Path) -> None:
    save_splats(folder / FILE_NAME, many_splats(SPLATS))


def _read_stored(path: Path) -> int:
    splats = load_splats(path)
    return len(splats)


def _manifest(folder: Path) -> None:
    (folder / "a.bin").write_bytes(b"a")
    from stages.run.digests import record_files

    records = record_files(folder)
    Manifest(
        *("seed", 4, {"fill": 2.5}, {"sfm": "ab" * 32}, records, "cd" * 32),
        *(1.5, 2.5, 300.0, "a processor", 7, {"photographs": records}),
    ).write(folder)


def _read_manifest(path: Path) -> int:
    assert Manifest.read(path.parent) is not None
    return 1


def _run_file(folder: Path) -> None:
    RunFile(Path("/photographs"), {"seed": {"fill": True}, "train": {"steps": 7}}).write(folder)


def _read_run_file(path: Path) -> int:
    assert RunFile.read(path.parent) is not None
    return 1


def _sealed(content: bytes) -> bytes:
    """With its digest, if it is an object."""
    try:
        data = json.loads(content)
    except (ValueError, RecursionError):
        return content
    if not isinstance(data, dict):
        return content
    data.pop("digest", None)
    schema = data.pop("schema", None)
    with tempfile.TemporaryDirectory() as folder:
        try:
            write_sealed(Path(folder) / MANIFEST, data | ({"schema": schema} if schema else {}))
        except (ValueError, RecursionError):
            return content
        return (Path(folder) / MANIFEST).read_bytes()


def _capture(folder: Path) -> None:
    rows = [
        Photo(f"{i}.jpg", name, 64, 48, 50.5, "camera", 1.5, -2.5, 9.0, gps=(1.5, 2.5))
        for i, name in enumerate(_PICTURES)
    ]
    save_capture(Capture(folder, tuple(rows)))


def _read_capture(path: Path) -> int:
    return len(load_capture(path.parent).photos)


def _checkpoint(folder: Path) -> None:
    start = many_splats(SPLATS)
    values = (start.means, start.quaternions, start.log_scales, start.opacity_logits, start.sh)
    model = new_model(*(np.asarray(array, np.float32) for array in values))
    state = checkpoint.TrainingState(7, (30, 0, 0.0), [HistoryEntry(7, SPLATS)], [], [])
    checkpoint.save_checkpoint(folder, model, state)


def _read_checkpoint(path: Path) -> int:
    """A damaged one is reported, renamed, and not used; here that counts as refused."""
    warnings: list[str] = []
    found = checkpoint.load_checkpoint(path.parent, lambda code, _: warnings.append(code))
    if found is None:
        assert warnings == ["train-checkpoint-damaged"]
        (words,) = warnings
        raise SplatError(words, given="", wanted="", hint="", family=Family.RUN_FOLDER)
    return len(found[0])


def _layer(
    name: str, write: Callable[[Path], object], read: Callable[[Path], int], **more: Any
) -> Layer:
    return Layer(name, lambda: _written(write, name), read=read, **{"holds": 1, **more})


LAYERS = {
    "splats.bin": _layer(FILE_NAME, _splats, _read_stored, holds=SPLATS),
    "manifest.json": _layer(MANIFEST, _manifest, _read_manifest, text=True),
    "manifest.json, sealed": _layer(MANIFEST, _manifest, _read_manifest, text=True, pack=_sealed),
    "run.json": _layer(RUN_FILE, _run_file, _read_run_file, text=True),
    "run.json, sealed": _layer(RUN_FILE, _run_file, _read_run_file, text=True, pack=_sealed),
    "capture.json": _layer(
        FILE,
        _capture,
        _read_capture,
        text=True,
        holds=len(_PICTURES),
        beside=lambda: dict.fromkeys(_PICTURES, b"a"),
    ),
    "checkpoint.bin": _layer(checkpoint.FILE_NAME, _checkpoint, _read_checkpoint, holds=SPLATS),
}
