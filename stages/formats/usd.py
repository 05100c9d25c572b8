"""USD: .usda, .usdc and .usdz with the schema ParticleField3DGaussianSplat (usd-core >= 26.3).

Linear scales and opacities, SH coefficients of one splat together, y up. Viewers silently replace
missing attributes by identity, unit scale, opaque, grey and degree 3, so all are written.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.base.atomic import partial_prefix, replacing
from stages.base.row_slices import row_slices
from stages.formats.first_camera import NAME, pose_of
from stages.formats.values import linear_opacities, linear_scales, unit_quaternions
from stages.scene import Camera, Splats
from stages.scene.draw_settings import near_plane_of
from stages.scene.flip import flipped
from stages.scene.rotations import matrices_of

_ROOT, _PRIM = "/Scene", "/Scene/Splats"
_FOCAL_LENGTH = 50.0  # of the schema
_FAR = 1e6  # the far plane, in near planes


def write(path: Path, splats: Splats, *, units: str = "arbitrary") -> None:
    """Write `splats` as `path` (.usda, .usdc or .usdz).

    Positions stay relative to `splats.origin`; customLayerData holds it, the place, both in the
    axes of the file, and the units. Raises SplatError when the file cannot be written.
    """
    path = Path(path)
    with replacing(path) as temporary:
        if path.suffix.lower() == ".usdz":
            _write_package(temporary, splats, units, f"{path.stem}.usdc")
        else:
            _export(_layer(splats, units, path.suffix.lower()), temporary)


def _layer(splats: Splats, units: str, suffix: str) -> Any:
    from pxr import Gf, Sdf, Usd, UsdGeom, UsdVol, Vt

    layer = Sdf.Layer.CreateAnonymous(suffix)
    stage = Usd.Stage.Open(layer)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(
        stage, 1.0
    )  # also for arbitrary units, which customLayerData names
    root = UsdGeom.Xform.Define(stage, _ROOT).GetPrim()
    stage.SetDefaultPrim(root)
    note: dict[str, Any] = {"units": units}
    y_up = flipped(splats.take(slice(0)))
    if splats.origin.any():
        note["origin"] = Gf.Vec3d(*map(float, y_up.origin))
    if y_up.place is not None:
        stated = y_up.place.beside(y_up.origin).to_json()
        axes = [value for row in stated["axes"] for value in row]
        note["place"] = {
            "crs": stated["crs"],
            "offset": Gf.Vec3d(*stated["offset"]),
            "axes": Gf.Matrix3d(*axes),
        }
    if splats.draw_settings.antialias:
        note["antialiased"] = True
    layer.customLayerData = {"splat": note}

    field = UsdVol.ParticleField3DGaussianSplat.Define(stage, _PRIM)
    base = splats.with_sh_degree(0)
    positions = _filled(Vt.Vec3fArray, base, lambda block: block.means)
    field.CreatePositionsAttr(positions)
    # Gf stores the real part last in memory, although it is the first argument.
    rotations = _filled(
        Vt.QuatfArray, base, lambda block: unit_quaternions(block.quaternions)[:, [1, 2, 3, 0]]
    )
    field.CreateOrientationsAttr(rotations)
    field.CreateScalesAttr(_filled(Vt.Vec3fArray, base, linear_scales))
    field.CreateOpacitiesAttr(_filled(Vt.FloatArray, base, linear_opacities))
    field.CreateRadianceSphericalHarmonicsDegreeAttr(splats.sh_degree)
    coefficients = _filled(Vt.Vec3fArray, splats, lambda block: block.sh.reshape(-1, 3))
    field.CreateRadianceSphericalHarmonicsCoefficientsAttr(coefficients)
    field.CreateProjectionModeHintAttr(UsdVol.Tokens.perspective)
    field.CreateSortingModeHintAttr(UsdVol.Tokens.zDepth)  # as the splats were trained
    if len(splats):
        field.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(_extent(base)))
    _add_camera(stage, y_up.first_camera, splats)
    colour = Usd.ColorSpaceAPI.Apply(field.GetPrim())
    colour.CreateColorSpaceNameAttr("srgb_rec709_scene")
    return layer


def _add_camera(stage: Any, camera: Camera | None, splats: Splats) -> None:
    """Define the first camera, which is in the axes of the file, if it is known."""
    from pxr import Gf, UsdGeom

    if camera is None or not len(splats):
        return
    prim = UsdGeom.Camera.Define(stage, f"{_ROOT}/{NAME}")
    prim.AddTransformOp().Set(Gf.Matrix4d(*pose_of(camera).T.ravel().tolist()))
    # Apertures and focal length are in the same unit: only their ratios matter.
    prim.CreateFocalLengthAttr(_FOCAL_LENGTH)
    prim.CreateHorizontalApertureAttr(_FOCAL_LENGTH * camera.width / camera.fx)
    prim.CreateVerticalApertureAttr(_FOCAL_LENGTH * camera.height / camera.fy)
    near = splats.draw_settings.near or near_plane_of(splats.means)
    prim.CreateClippingRangeAttr(Gf.Vec2f(near, near * _FAR))


def _filled(kind: Any, splats: Splats, values_of: Callable[[Splats], NDArray[Any]]) -> Any:
    """A USD array of `values_of` the splats, y up. The library copies its arguments, so it gets
    one block at a time."""
    array, end = kind(0), 0
    for rows in row_slices(len(splats)):
        values = np.ascontiguousarray(values_of(flipped(splats.take(rows))), np.float32)
        if not end:
            array = kind(len(values) // (rows.stop - rows.start) * len(splats))
        array[end : end + len(values)] = kind.FromNumpy(values)
        end += len(values)
    return array


def _extent(splats: Splats) -> NDArray[np.float32]:
    """[2, 3] the bounding box of all ellipsoids of 3 standard deviations, y up."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for rows in row_slices(len(splats)):
        block = flipped(splats.take(rows))
        reach = _reach(unit_quaternions(block.quaternions), linear_scales(block))
        low = np.minimum(low, (block.means - reach).min(axis=0))
        high = np.maximum(high, (block.means + reach).max(axis=0))
    most = np.finfo(np.float32).max
    return np.asarray(np.clip(np.stack([low, high]), -most, most).astype(np.float32))


def _reach(unit: NDArray[np.float32], scales: NDArray[np.float32]) -> NDArray[np.float64]:
    """[N, 3] half the bounding box of each ellipsoid."""
    axes = matrices_of(unit)
    squares = np.einsum("nij,nj->ni", axes**2, scales.astype(np.float64) ** 2)
    return np.asarray(3 * np.sqrt(squares))


def _export(layer: Any, path: Path) -> None:
    from pxr import Tf

    try:
        done = layer.Export(str(path))
    except Tf.ErrorException as error:
        raise OSError("the USD library could not write it") from error
    if not done:
        raise OSError("the USD library could not write it")


def _write_package(path: Path, splats: Splats, units: str, name: str) -> None:
    """Write a .usdz: an uncompressed zip with files aligned to 64 bytes, the scene first.

    The zip writer copies the local time of the file; a fixed time keeps the bytes equal.
    """
    from pxr import Sdf

    with tempfile.TemporaryDirectory(prefix=partial_prefix(), dir=path.parent) as folder:
        inner = Path(folder) / "scene.usdc"
        _export(_layer(splats, units, ".usdc"), inner)
        moment = time.mktime((1980, 1, 1, 12, 0, 0, 0, 0, -1))
        os.utime(inner, (moment, moment))
        with Sdf.ZipFileWriter.CreateNew(str(path)) as package:
            if not package.AddFile(str(inner), _archive_name(name)):
                raise OSError("the USD library could not write it")


def _archive_name(name: str) -> str:
    """An ASCII name: brackets separate names inside packages, and zip has several encodings."""
    ascii_name = "".join(c if c.isascii() and (c.isalnum() or c in "-_.") else "_" for c in name)
    return ascii_name.lstrip(".") or "scene.usdc"
