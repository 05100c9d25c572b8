"""Thread pools and the kernel cache, set up before torch, Numba or OpenCV load.

OpenMP's default is to spin while it waits. With another process on the same cores a training run
then takes ten times as long, and laptops are busy machines.
"""

from __future__ import annotations

import hashlib
import os
import sys
import tempfile
from pathlib import Path


def configure() -> None:
    """Set OpenMP's waiting policy and where Numba keeps compiled kernels, unless the user did."""
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    os.environ.setdefault("NUMBA_CACHE_DIR", str(kernel_cache()))


def kernel_cache() -> Path:
    """The folder of compiled kernels for exactly these sources.

    Numba notices a changed kernel file but not a changed file that it imports from; a folder per
    digest of all of them cannot serve a stale kernel, and works where the package is read-only.
    """
    digest = hashlib.sha256(sys.version.encode())
    stages = Path(__file__).resolve().parent.parent
    for source in sorted(
        [
            *stages.glob("kernels/*.py"),
            *stages.glob("raster/**/*.py"),
            *stages.glob("training/*.py"),
            *stages.glob("surface/*.py"),
        ]
    ):
        digest.update(source.name.encode() + source.read_bytes())
    base = os.environ.get("XDG_CACHE_HOME") or os.environ.get("LOCALAPPDATA") or ""
    root = Path(base) if base else Path("~/.cache").expanduser()
    folder = root / "splat" / f"kernels-{digest.hexdigest()[:16]}"
    if not _writable(folder):
        folder = Path(tempfile.gettempdir()) / f"splat-{folder.name}"
    return folder


def kernels_are_compiled() -> bool:
    """Whether an earlier run left compiled kernels; the first one compiles for half a minute."""
    return any(Path(os.environ.get("NUMBA_CACHE_DIR", kernel_cache())).rglob("*.nbi"))


def _writable(folder: Path) -> bool:
    """Numba stops the program when it can write nowhere; a home folder may be read-only."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return False
    return os.access(folder, os.W_OK)


def count() -> int:
    """Threads to use: SPLAT_THREADS if set, else the cores that this process may run on."""
    wanted = os.environ.get("SPLAT_THREADS", "")
    if wanted.isdigit() and int(wanted) > 0:
        return int(wanted)
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # macOS, Windows
        return os.cpu_count() or 1
