"""Where compiled kernels are kept: one folder for each set of sources, compiler and processor.

Numba notices a changed kernel file, but not a change in a file that it imports. A folder named by
the digest of all of them cannot serve a stale kernel, and works where the package is read-only.
Folders of other versions are removed, except the most recent and those that were used within a day.
A process that still uses one that is removed compiles again what it has not loaded yet.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import sys
import tempfile
import time
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path

import llvmlite.binding as llvm

KEPT = 3  # folders of compiled kernels, the one in use included
PACKAGES = ("mesh", "raster", "sfm", "train")  # those with kernels
_VARIABLE = "NUMBA_CACHE_DIR"
UNUSED_S = 24 * 3600.0  # since a process began to use a folder, before it may be removed


def folder() -> Path:
    """The folder where this process reads and writes compiled kernels."""
    return Path(os.environ[_VARIABLE])


def are_compiled(kernel: str = "*") -> bool:
    """Whether there are compiled kernels; if not, the first use compiles for a while."""
    return any(folder().rglob(f"*.{kernel}-*.nbi"))


def others() -> list[Path]:
    """Folders of other versions and machines beside this process's, most recently used first."""
    found = [path for path in folder().parent.glob("kernels-*") if path != folder()]
    with suppress(OSError):  # another process may be removing one
        found.sort(key=_last_use, reverse=True)
    return found


def size_bytes(kernels: Path) -> int:
    """Size of all files in a folder of kernels."""
    return sum(path.stat().st_size for path in kernels.rglob("*") if path.is_file())


def prepare() -> None:
    """Make the folder, tell Numba of it, and remove old ones; nothing if the user named a folder.

    To be called before Numba is imported. Raises OSError where nothing can be written at all.
    """
    if os.environ.get(_VARIABLE):
        return
    name = f"kernels-{_digest()}"
    root = _root()
    try:
        _use(root, name)
    except OSError:  # a home folder may be read-only, and Numba stops where it cannot write
        root = Path(tempfile.gettempdir()) / f"splat-{_user()}"
        root.mkdir(mode=0o700, exist_ok=True)
        if _owner(root) != _user():  # compiled kernels are code: only our own may be run
            root = Path(tempfile.mkdtemp(prefix="splat-"))
        _use(root, name)


def _digest() -> str:
    processor = os.environ.get("NUMBA_CPU_NAME") or llvm.get_host_cpu_name()
    features = llvm.get_host_cpu_features().flatten()
    digest = hashlib.sha256("\n".join((sys.version, processor, features)).encode())
    digest.update((version("numba") + version("llvmlite")).encode())
    stages = Path(__file__).resolve().parents[2]
    for source in sorted(path for name in PACKAGES for path in (stages / name).rglob("*.py")):
        digest.update(source.relative_to(stages).as_posix().encode() + source.read_bytes())
    return digest.hexdigest()[:16]


def _root() -> Path:
    base = os.environ.get("XDG_CACHE_HOME") or os.environ.get("LOCALAPPDATA")
    return (Path(base) if base else Path("~/.cache").expanduser()) / "splat"


def _user() -> int:
    return os.getuid() if hasattr(os, "getuid") else 0


def _owner(path: Path) -> int:
    return path.stat().st_uid  # 0 under Windows, whose temporary folder is the user's own


def _use(root: Path, name: str) -> None:
    """Make the folder of kernels `name` under `root`, mark it as used now, and remove old ones.
    Raises OSError where nothing can be written."""
    kernels = root / name
    kernels.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryFile(dir=kernels):
        os.utime(kernels)
    os.environ[_VARIABLE] = str(kernels)
    for path in others()[KEPT - 1 :]:
        with suppress(OSError):  # another process may be removing it
            if _last_use(path) < time.time() - UNUSED_S:
                shutil.rmtree(path)


def _last_use(path: Path) -> float:
    """When a process last began to use a folder of kernels, or added one."""
    return path.stat().st_mtime
