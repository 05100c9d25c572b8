"""Reading Gaussian splats from USD, in a child process.

The USD library aborts the process for some kinds of damage in a .usdc, so a child opens the file:
`python -m stages.formats.usd_read FILE OUTPUT [allow-nonfinite | units]` writes the splats (see
stages.scene.storage) or the declared units to OUTPUT, or prints the reason why it cannot.
"""

from __future__ import annotations

import math
import subprocess
import sys
import tempfile
from contextlib import nullcontext, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.base.bad_files import BadFileError
from stages.base.parent import end_child, how_it_ended, python_module, start_child
from stages.base.text import reason_of
from stages.base.usd_path import accepted_path
from stages.formats.first_camera import camera_of
from stages.formats.json_fields import place_of
from stages.formats.values import (
    allows_nonfinite,
    check_finite,
    concatenate,
    log_scales_of,
    logits_of,
    nonfinite_allowed,
)
from stages.scene import Camera, Splats, load_splats, save_splats
from stages.scene.flip import flipped
from stages.scene.recentring import recentred_splats

_TYPE = "ParticleField3DGaussianSplat"
_ARCS = ("references", "payload", "inheritPaths", "specializes", "clips")
_UNITS = "units"
_REFUSED = 3  # exit status of the child when it printed a reason
_TIMEOUT_SECONDS = 600
# Memory of the child: beyond the library's, and per byte of the file (arrays may be compressed).
_BASE_BYTES, _BYTES_PER_BYTE = 192 << 20, 64
_THREADS = "4"  # of the library; the stack of each counts as memory


def read(path: Path) -> Splats:
    """All Gaussian splats of a USD file, y down, float32.

    Prims may be translated and uniformly scaled; the up axis must be y. Positions far from zero
    keep their precision in `origin`. Of cameras the first in perspective is kept. Raises
    BadFileError for a damaged file, one without splats, one that refers to other files, or one
    with rotated splats.
    """
    with tempfile.TemporaryDirectory() as folder:
        output = Path(folder) / "splats.bin"
        _in_child(path, output, *(["allow-nonfinite"] if allows_nonfinite() else []))
        return load_splats(output)


def units(path: Path) -> str:
    """The units that a USD file declares; "" if it declares none. Raises BadFileError as `read`."""
    with tempfile.TemporaryDirectory() as folder:
        output = Path(folder) / "units.txt"
        _in_child(path, output, _UNITS)
        return output.read_text(encoding="utf-8")


def _in_child(path: Path, output: Path, *flags: str) -> None:
    """`main` in a child process. output: in a folder that is deleted afterwards."""
    command = python_module("stages.formats.usd_read", str(path.resolve()), str(output), *flags)
    # The library writes crash reports to TMPDIR.
    environment = {"TMPDIR": str(output.parent), "PXR_WORK_THREAD_LIMIT": _THREADS}
    child = start_child(command, subprocess.PIPE, environment)
    try:
        said, _ = child.communicate(timeout=_TIMEOUT_SECONDS)
    except subprocess.TimeoutExpired as error:
        raise BadFileError(f"it was not read within {_TIMEOUT_SECONDS} s") from error
    finally:
        end_child(child)
    if child.returncode == _REFUSED:
        raise BadFileError(said.decode("utf-8", "replace").strip()[:300])
    if child.returncode != 0:
        how = how_it_ended(child.returncode)
        raise BadFileError(f"it is damaged: the USD library ended with {how} on it")


def parse(path: Path) -> Splats:
    """`read`, in this process. Raises BadFileError, or what the USD library raises."""
    with accepted_path(path) as name:
        return _parsed(_open(name))


def _parsed(stage: Any) -> Splats:
    parts = [_splats(prim) for prim in stage.Traverse() if prim.GetTypeName() == _TYPE]
    if not parts:
        raise BadFileError(f"it holds no {_TYPE}")
    splats = concatenate(parts)
    del parts
    note = _note(stage)
    origin = np.array(note.get("origin", np.zeros(3)), np.float64).reshape(3)
    place = place_of(note.get("place"), origin)
    splats = replace(splats, origin=origin, place=place, first_camera=_first_camera(stage))
    splats = recentred_splats(splats).with_antialias(bool(note.get("antialiased", False)))
    return check_finite(flipped(splats, reuse=True))


def _first_camera(stage: Any) -> Camera | None:
    """The first camera in perspective, in the axes of the file; None if there is none."""
    from pxr import Usd, UsdGeom

    for camera in map(UsdGeom.Camera, stage.Traverse()):
        if camera and camera.GetProjectionAttr().Get() == UsdGeom.Tokens.perspective:
            pose = np.array(camera.ComputeLocalToWorldTransform(Usd.TimeCode.Default())).T
            attributes = (camera.GetHorizontalApertureAttr(), camera.GetVerticalApertureAttr())
            focal = camera.GetFocalLengthAttr().Get() or math.nan
            return camera_of(pose, *(attribute.Get() / focal for attribute in attributes))
    return None


def _note(stage: Any) -> dict[str, Any]:
    """What our writer notes of the scene; {} in files of other programs."""
    note = stage.GetRootLayer().customLayerData.get("splat")
    return note if isinstance(note, dict) else {}


def _open(name: str) -> Any:
    from pxr import Sdf, Usd, UsdGeom

    layer = Sdf.Layer.OpenAsAnonymous(name)
    if layer is None:
        raise BadFileError("it is not USD")
    if layer.GetCompositionAssetDependencies():
        raise BadFileError("it refers to other files, which are not supported")
    _refuse_arcs(layer)
    stage = Usd.Stage.Open(layer)
    if UsdGeom.GetStageUpAxis(stage) != UsdGeom.Tokens.y:
        raise BadFileError("its up axis is not y, which is not supported")
    return stage


def _refuse_arcs(layer: Any) -> None:
    """Raise BadFileError if a prim is composed of others: a few kilobytes of prims that refer to
    each other twice make millions."""

    def check(path: Any) -> None:
        spec = layer.GetPrimAtPath(path) if path.IsPrimPath() else None
        if spec and any(spec.HasInfo(name) for name in _ARCS):
            raise BadFileError("its prims are made of each other, which is not supported")

    layer.Traverse("/", check)


def _splats(prim: Any) -> Splats:
    """One particle field, in the axes of the file."""
    means = _array(prim, "positions", 3)
    n = len(means)
    orientations = _array(prim, "orientations", 4)
    scales = _array(prim, "scales", 3)
    opacities = _array(prim, "opacities", 1)[:, 0]
    degree = prim.GetAttribute("radiance:sphericalHarmonicsDegree").Get()
    coefficients = _array(prim, "radiance:sphericalHarmonicsCoefficients", 3)
    if degree not in (0, 1, 2, 3):
        raise BadFileError(f"its SH degree is {degree}, not 0 to 3")
    wanted = {"orientations": n, "scales": n, "opacities": n, "coefficients": n * (degree + 1) ** 2}
    lengths = (len(orientations), len(scales), len(opacities), len(coefficients))
    for (name, length), given in zip(wanted.items(), lengths, strict=True):
        if given != length:
            raise BadFileError(f"it has {given} {name} for {n} splats, wanted {length}")
    scale, offset = _placement(prim)
    return Splats(
        means=means.astype(np.float64) * scale + offset,  # `parse` recentres them
        quaternions=orientations[:, [3, 0, 1, 2]],
        log_scales=log_scales_of(scales, scale),
        opacity_logits=logits_of(opacities),
        sh=coefficients.reshape(n, (degree + 1) ** 2, 3).copy(),
        sh_degrees=np.full(n, degree, np.uint8),
    )


def _array(prim: Any, name: str, width: int) -> NDArray[np.float32]:
    """[N, width] float32, read-only: the attribute, or its half-precision form ("...h") where only
    that is set."""
    for attribute in (prim.GetAttribute(name), prim.GetAttribute(name + "h")):
        value = attribute.Get() if attribute else None
        if value is not None:
            return np.asarray(value, np.float32).reshape(-1, width)
    raise BadFileError(f"its splats have no {name}")


def _placement(prim: Any) -> tuple[float, NDArray[np.float64]]:
    """(scale, offset) of the prim in the world."""
    from pxr import Usd, UsdGeom

    matrix = np.array(UsdGeom.XformCache(Usd.TimeCode.Default()).GetLocalToWorldTransform(prim))
    scale = float(matrix[0, 0])
    if not (np.isfinite(matrix).all() and scale > 0):
        raise BadFileError("its splats are mirrored or have no size")
    if np.abs(matrix[:3, :3] / scale - np.eye(3)).max() > 1e-6:
        raise BadFileError("its splats are rotated or stretched, which is not supported")
    return scale, matrix[3, :3]


def _limit_memory(path: Path) -> None:
    with suppress(ImportError, ValueError, OSError):  # on Linux only; or limited already
        import resource  # not on Windows

        from pxr import Sdf, Usd, UsdGeom  # noqa: F401 - loaded before it is measured

        now = int(Path("/proc/self/statm").read_text().split()[5]) * resource.getpagesize()
        wanted = now + _BASE_BYTES + _BYTES_PER_BYTE * path.stat().st_size
        hard = resource.getrlimit(resource.RLIMIT_DATA)[1]
        resource.setrlimit(resource.RLIMIT_DATA, (wanted, hard))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def main(arguments: list[str]) -> int:
    """The child. Exit status 0: the splats, or the units, are in the second file; 3: the reason is
    printed."""
    source, output = map(Path, arguments[:2])
    _limit_memory(source)
    try:
        if arguments[2:] == [_UNITS]:
            with accepted_path(source) as name:
                units = str(_note(_open(name)).get("units", ""))
            output.write_text(units, encoding="utf-8")
            return 0
        with nonfinite_allowed() if arguments[2:] else nullcontext():
            splats = parse(source)
    except BadFileError as error:
        print(error)
        return _REFUSED
    except Exception as error:  # errors of the library, and consequences of damaged values
        print(f"it is damaged ({reason_of(error)})")
        return _REFUSED
    save_splats(output, splats)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
