"""Cameras of other programs: nerfstudio's file, each file of a COLMAP model, binary and text."""

from __future__ import annotations

import functools
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from stages.cameras import colmap, nerfstudio
from stages.scene import Camera, View
from tests.cameras.models import example
from tests.fuzz.layer import Layer

_MOST = 1 << 12  # more cannot come out of files of some 20 kB


@functools.cache
def _files(kind: str) -> dict[str, bytes]:
    """A capture of five views: transforms.json, or a model as "bin" (ours) or "txt" (COLMAP's)."""
    model = example()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if kind == "json":
            views = [View(n, n, c) for n, c in zip(model.names, model.cameras, strict=True)]
            nerfstudio.write(folder / "transforms.json", views, folder)
        else:
            colmap.write_colmap_model(folder, model)
        if kind == "txt":
            import pycolmap

            pycolmap.Reconstruction(folder).write_text(folder)
        return {path.name: path.read_bytes() for path in folder.glob(f"*.{kind}")}


def _checked(cameras: list[Camera]) -> int:
    assert 0 < len(cameras) <= _MOST
    for camera in cameras:
        assert np.isfinite(camera.world_to_camera).all()
        assert np.isfinite([camera.fx, camera.fy, camera.cx, camera.cy]).all()
        assert min(camera.width, camera.height) > 0
    return len(cameras)


def _read_transforms(path: Path) -> int:
    return _checked([view.camera for view in nerfstudio.read(path).views])


def _read_model(path: Path) -> int:
    found, model = colmap.read_model(path.parent)
    assert len(model.points) <= _MOST
    assert len(model.observed_px) <= _MOST
    assert np.isfinite(model.points).all()
    return _checked([view.camera for view in found.views])


def _part(kind: str, name: str) -> Layer:
    def beside() -> dict[str, bytes]:
        return {other: content for other, content in _files(kind).items() if other != name}

    return Layer(
        name, _content(kind, name), beside=beside, text=kind != "bin", read=_read_model, holds=5
    )


def _content(kind: str, name: str) -> Callable[[], bytes]:
    return lambda: _files(kind)[name]


LAYERS = {
    "transforms.json": Layer(
        "transforms.json",
        _content("json", "transforms.json"),
        text=True,
        read=_read_transforms,
        holds=5,
    ),
    **{
        f"COLMAP {part}.{kind}": _part(kind, f"{part}.{kind}")
        for kind in ("bin", "txt")
        for part in ("cameras", "images", "points3D")
    },
}
