"""The values that other people's readers find in our files, as splats in the file's own axes."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.formats import format_of
from stages.proof.checks import read_back
from stages.proof.content import Y_DOWN, Y_UP, FileContent, logits, splats_of
from tests.formats.files import glb_parts
from tests.packages import UnavailableError, installed, node

HERE = Path(__file__).parent


@dataclass(frozen=True)
class Reader:
    """name, with the version that it was tried with; the formats that it reads; `read` raises
    UnavailableError where it is not installed."""

    name: str
    formats: tuple[str, ...]
    read: Callable[[Path], FileContent]


def _gsply(path: Path) -> FileContent:
    gsply: Any = _imported("gsply")
    if path.suffix == ".ply":
        data = gsply.plyread(path)
    else:
        with _spz_in(path) as spz:
            data = gsply.read_spz(spz)
    rest = data.shN if data.shN is not None else np.zeros((len(data.means), 0, 3))
    return FileContent(
        splats_of(
            means=data.means,
            quaternions=data.quats,
            log_scales=data.scales,
            opacity_logits=data.opacities,
            sh=np.concatenate([data.sh0[:, None], rest], axis=1),
        ),
        _axes(path),
    )


def _open3d(path: Path) -> FileContent:
    """Scales linear, SH after the DC channel by channel."""
    open3d: Any = _imported("open3d")
    cloud = open3d.t.io.read_point_cloud(str(path))
    values = {name: cloud.point[name].numpy() for name in cloud.point}
    count = len(values["positions"])
    sh = values["f_dc"].reshape(count, 1, 3)
    if "f_rest" in values:
        rest = values["f_rest"].reshape(count, -1, 3)
        sh = np.concatenate([sh, rest], axis=1)
    return FileContent(
        splats_of(
            means=values["positions"],
            quaternions=values["rot"],
            log_scales=np.log(values["scale"]),
            opacity_logits=values["opacity"][:, 0],
            sh=sh,
        ),
        _axes(path),
    )


def _tinyusdz(path: Path) -> FileContent:
    """Quaternions as they lie in memory in USD: the real part last."""
    tinyusdz: Any = _imported("tinyusdz")
    stage = tinyusdz.load(str(path))
    assert stage.get_metadata("upAxis") == "Y"
    prim = stage.get_prim_at_path("/Scene/Splats")
    assert prim.type_name == "ParticleField3DGaussianSplat"

    def values(name: str) -> np.ndarray:
        return np.asarray(memoryview(prim.get_attribute(name).value))

    degree = prim.get_attribute("radiance:sphericalHarmonicsDegree").value.as_scalar()
    coefficients = values("radiance:sphericalHarmonicsCoefficients")
    return FileContent(
        splats_of(
            means=values("positions"),
            quaternions=np.roll(values("orientations"), 1, axis=1),
            log_scales=np.log(values("scales").astype(np.float64)),
            opacity_logits=logits(values("opacities")),
            sh=coefficients.reshape(-1, (degree + 1) ** 2, 3),
        ),
        _axes(path),
    )


def _splat_transform(path: Path) -> FileContent:
    """Written by it as .ply, and that read by plyfile; it leaves the axes as they are."""
    command = installed(HERE) / "@playcanvas" / "splat-transform" / "bin" / "cli.mjs"
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out.ply"
        node().run(command, path, out)
        return replace(read_back(out), world_from_file=_axes(path))


def _adobe_spz(path: Path) -> FileContent:
    """Colours there are DC coefficients already; SH are coefficient by coefficient, RGB last."""
    with tempfile.TemporaryDirectory() as folder, _spz_in(path) as spz:
        out = Path(folder) / "values"
        said = node().run(HERE / "scripts" / "spz.mjs", installed(HERE), spz, out)
        about = json.loads(said.splitlines()[-1])  # the library talks too
        count, bands = about["count"], (about["degree"] + 1) ** 2 - 1
        flat = np.fromfile(out, "<f4")
    ends = np.cumsum([3 * count, 3 * count, 4 * count, count, 3 * count])
    means, scales, rotations, alphas, colours, sh = np.split(flat, ends)
    dc = colours.reshape(count, 1, 3)
    return FileContent(
        splats_of(
            means=means.reshape(count, 3),
            quaternions=np.roll(rotations.reshape(count, 4), 1, axis=1),
            log_scales=scales.reshape(count, 3),
            opacity_logits=alphas,
            sh=np.concatenate([dc, sh.reshape(count, bands, 3)], axis=1),
        ),
        _axes(path),
    )


@contextmanager
def _spz_in(path: Path) -> Iterator[Path]:
    """The .spz that a .glb holds, or a .spz itself."""
    if path.suffix != ".glb":
        yield path
        return
    document, binary = glb_parts(path)
    primitive = document["meshes"][0]["primitives"][0]
    (compression,) = primitive["extensions"]["KHR_gaussian_splatting"]["extensions"].values()
    view = document["bufferViews"][compression["bufferView"]]
    with tempfile.TemporaryDirectory() as folder:
        payload = Path(folder) / "payload.spz"
        payload.write_bytes(binary[: view["byteLength"]])
        yield payload


def _axes(path: Path) -> NDArray[np.float64]:
    return Y_UP if format_of(path).y_up else Y_DOWN


def _imported(name: str) -> Any:
    import importlib

    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise UnavailableError(f"{name} is not installed ({error})") from error


READERS = (
    Reader("plyfile", ("ply",), read_back),
    Reader("pygltflib", ("glb", "gltf", "quantised.glb", "spz.glb"), read_back),
    Reader("usd-core", ("usda", "usdc", "usdz"), read_back),
    Reader("gsply", ("ply", "compressed.ply", "spz", "v4.spz", "spz.glb"), _gsply),
    Reader("tinyusdz", ("usda", "usdc", "usdz"), _tinyusdz),
    Reader(
        "splat-transform",
        ("ply", "splat", "compressed.ply", "spz", "v4.spz", "sog", "lod-meta.json"),
        _splat_transform,
    ),
    Reader("@adobe/spz", ("spz", "v4.spz", "spz.glb"), _adobe_spz),
    Reader("Open3D", ("ply", "splat", "spz", "v4.spz"), _open3d),
)
