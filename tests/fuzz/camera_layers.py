"""Cameras of other programs: each of their files; of a COLMAP model as binary and as text."""

from __future__ import annotations

import functools
import io
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np

from stages.cameras import (
    arkit,
    blender,
    bundler,
    colmap,
    inria,
    llff,
    metashape,
    nerfstudio,
    opensfm,
    opf,
    realityscan,
    realityscan_xmp,
)
from stages.scene import Camera, View
from tests.cameras.drawn_surveys import MADE, NAMES
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
            model.write(folder)
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
    nerfstudio.read_points(path)
    return _checked([view.camera for view in nerfstudio.read(path).views])


def _read_points(path: Path) -> int:
    found = nerfstudio.read_points(path.with_name("transforms.json"))
    assert found is not None
    assert len(found.points) <= _MOST
    assert np.isfinite(found.points).all()
    return len(found.points)


@functools.cache
def _points(text: bool) -> bytes:
    from plyfile import PlyData

    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / "transforms.json"
        model = example()
        views = [View(n, n, c) for n, c in zip(model.names, model.cameras, strict=True)]
        nerfstudio.write(path, views, path.parent, model.cloud.points, model.cloud.colours)
        data = PlyData.read(str(path.with_name(f"{path.stem}_points.ply")))
        data.text = text
        out = io.BytesIO()
        data.write(out)
        return out.getvalue()


def _points_layer(text: bool) -> Layer:
    whole = _files("json")["transforms.json"]
    naming = whole.replace(b"{", b'{"ply_file_path": "transforms.ply",', 1)
    return Layer(
        "transforms.ply",
        lambda: _points(text),
        beside=lambda: {"transforms.json": naming},
        text=True,
        read=_read_points,
        holds=len(example().cloud.points),
    )


def _picture() -> Layer:
    """A picture whose size a camera file needs."""
    name = f"images/{NAMES[0]}"

    def read(path: Path) -> int:
        file = path.parents[1] / "cameras.csv"
        return _checked([view.camera for view in realityscan.read(file).views])

    def beside() -> dict[str, bytes]:
        return {other: data for other, data in _drawn("realityscan").items() if other != name}

    return Layer(name, lambda: _drawn("realityscan")[name], beside=beside, read=read, holds=4)


def _read_model(path: Path) -> int:
    found, cloud, observations = colmap.read_model(path.parent)
    assert len(cloud.points) <= _MOST
    assert len(observations.px) <= _MOST
    assert np.isfinite(cloud.points).all()
    return _checked([view.camera for view in found.views])


def _part(kind: str, name: str) -> Layer:
    def beside() -> dict[str, bytes]:
        return {other: content for other, content in _files(kind).items() if other != name}

    return Layer(
        name, _content(kind, name), beside=beside, text=kind != "bin", read=_read_model, holds=5
    )


@functools.cache
def _drawn(kind: str) -> dict[str, bytes]:
    """A capture of four views, its pictures too, as `kind` names them."""
    with tempfile.TemporaryDirectory() as name:
        MADE[kind](Path(name))
        files = [path for path in Path(name).rglob("*") if path.is_file()]
        return {path.relative_to(name).as_posix(): path.read_bytes() for path in files}


def _other(module: ModuleType, name: str, text: bool = True, source: str = "") -> Layer:
    """A file of a format of one reader, with what lies around it. source: what is read, if it is
    another file or the folder (".")."""
    kind = module.__name__.rpartition(".")[2]

    def read(path: Path) -> int:
        place = path.parents[name.count("/")] / (source or name)
        if hasattr(module, "read_points"):
            found = module.read_points(place)
            assert found is None or np.isfinite(found.points).all()
        for lens in module.read(place).lenses:
            assert np.isfinite([*lens.radial, *lens.tangential]).all()
        return _checked([view.camera for view in module.read(place).views])

    def beside() -> dict[str, bytes]:
        return {other: content for other, content in _drawn(kind).items() if other != name}

    return Layer(name, lambda: _drawn(kind)[name], beside=beside, text=text, read=read, holds=4)


def _bundle_of_list(path: Path) -> int:
    return _checked([view.camera for view in bundler.read(path.with_name("bundle.out")).views])


def _content(kind: str, name: str) -> Callable[[], bytes]:
    return lambda: _files(kind)[name]


LAYERS = {
    "synthetic NeRF transforms_train.json": _other(blender, "transforms_train.json", source="."),
    "poses_bounds.npy": _other(llff, "poses_bounds.npy", text=False),
    "OpenSfM reconstruction.json": _other(opensfm, "reconstruction.json"),
    "3DGS cameras.json": _other(inria, "cameras.json"),
    "Metashape cameras.xml": _other(metashape, "cameras.xml"),
    "RealityScan cameras.csv": _other(realityscan, "cameras.csv"),
    "Bundler bundle.out": _other(bundler, "bundle.out"),
    "Bundler list.txt": replace(_other(bundler, "list.txt"), read=_bundle_of_list),
    "ARKit frame_00006.json": _other(arkit, "frame_00006.json", source="."),
    "RealityScan .xmp": _other(realityscan_xmp, "p_1.xmp", source="."),
    "OPF project.opf": _other(opf, "project.opf"),
    **{
        f"OPF {part}.json": _other(opf, f"{part}.json", source="project.opf")
        for part in ("calibrated-cameras", "input-cameras", "scene-reference-frame")
    },
    "transforms.json": Layer(
        "transforms.json",
        _content("json", "transforms.json"),
        text=True,
        read=_read_transforms,
        holds=5,
    ),
    "points of transforms.json": _points_layer(text=False),
    "points of transforms.json, ascii": _points_layer(text=True),
    "a picture of cameras": _picture(),
    **{
        f"COLMAP {part}.{kind}": _part(kind, f"{part}.{kind}")
        for kind in ("bin", "txt")
        for part in ("cameras", "images", "points3D")
    },
}
