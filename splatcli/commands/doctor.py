"""`splat doctor`: what this machine has, and what is missing."""

from __future__ import annotations

import importlib
import os
import platform
import shutil
import tempfile
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

from splatcli import console
from stages.base import threads
from stages.base.errors import Family
from stages.base.lazy import named
from stages.base.libraries import versions
from stages.base.memory import available_mib
from stages.raster.backends import BACKENDS, Backend

_MODULES = {
    "av": "av",
    "fast-simplification": "fast_simplification",
    "numba": "numba",
    "numpy": "numpy",
    "opencv-contrib-python-headless": "cv2",
    "pillow": "PIL",
    "pillow-heif": "pillow_heif",
    "plyfile": "plyfile",
    "pycolmap": "pycolmap",
    "pygltflib": "pygltflib",
    "scikit-image": "skimage",
    "scipy": "scipy",
    "torch": "torch",
    "usd-core": "pxr",
}
_LITTLE_MEMORY_MIB = 2048.0
_LITTLE_DISK_BYTES = 2_000_000_000


@dataclass(frozen=True)
class Check:
    """name, value: as shown. ok: False when something needed is missing. advice: what to do."""

    name: str
    value: str
    ok: bool = True
    advice: str = ""


def show(as_json: bool = False) -> int:
    """Print all checks; returns the exit status, 0 when nothing needed is missing."""
    found = list(checks())
    missing = [check for check in found if not check.ok]
    if as_json:
        console.emit("doctor", ok=not missing, checks=[asdict(check) for check in found])
    else:
        marks = {True: "ok", False: "MISSING"}
        rows = [(c.name, marks[c.ok], " ".join(filter(None, (c.value, c.advice)))) for c in found]
        console.table(("check", "", "value"), rows)
    return int(Family.RESOURCES) if missing else 0


def checks() -> Iterator[Check]:
    """Every check, in the order shown."""
    yield Check("splat", versions().get("splat", "not installed as a package"))
    yield Check("python", f"{platform.python_version()} on {platform.platform()}")
    yield from map(_library, _MODULES)
    yield Check("threads", f"{threads.count()} of {os.cpu_count()} cores (SPLAT_THREADS sets it)")
    yield Check("OMP_WAIT_POLICY", os.environ.get("OMP_WAIT_POLICY", "not set"))
    yield _memory()
    yield _disk()
    yield _numba_cache()
    for backend in BACKENDS:
        yield _backend(backend)


def _library(distribution: str) -> Check:
    found = versions().get(distribution)
    try:
        importlib.import_module(_MODULES[distribution])
    except Exception as error:  # a broken library may raise anything while it loads
        said = str(error).splitlines()[0] if str(error) else type(error).__name__
        return Check(distribution, said, ok=False, advice="Install splat again: pip install .")
    return Check(distribution, found or "present")


def _memory() -> Check:
    free = available_mib()
    if free is None:
        return Check("free memory", "unknown")
    enough = free >= _LITTLE_MEMORY_MIB
    advice = "" if enough else "Little: use --preset preview and a smaller --train-side."
    return Check("free memory", f"{free:,.0f} MiB", advice=advice)


def _disk() -> Check:
    free = shutil.disk_usage(Path()).free
    advice = "" if free >= _LITTLE_DISK_BYTES else "Little: a run needs about 1 GB."
    return Check("free disk here", console.size(free), advice=advice)


def _numba_cache() -> Check:
    import stages.raster

    named = os.environ.get("NUMBA_CACHE_DIR")
    folder = Path(named) if named else Path(next(iter(stages.raster.__path__)))
    try:
        with tempfile.NamedTemporaryFile(dir=folder):
            return Check("kernel cache", f"{folder} is writable")
    except OSError as error:
        where = f"{folder}: {error.strerror}"
        return Check("kernel cache", where, advice="Kernels are kept in your home folder instead.")


def _backend(backend: Backend) -> Check:
    label = f"backend {backend.name}"
    try:
        named(backend.rasteriser)
    except Exception as error:
        said = str(error).splitlines()[0] if str(error) else type(error).__name__
        return Check(label, f"not present ({said})", ok=False)
    return Check(label, "present")
