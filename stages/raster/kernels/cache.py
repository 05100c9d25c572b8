"""Where compiled kernels are kept: a folder for exactly these sources, compiler and processor.

Numba notices a changed kernel file, but not a changed file that it imports from; a folder per
digest of all of them cannot serve a stale kernel, and works where the package is read-only.
Folders of other versions are removed, less the newest few and those that a running process holds.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import sys
import tempfile
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path
from typing import IO

KEPT = 3  # folders of compiled kernels: one for each version or machine that is in turn
_VARIABLE = "NUMBA_CACHE_DIR"
_ROOMS = ("kernels", "raster", "training", "surface", "seeding", "structure")
_IN_USE = "in-use"  # locked, as long as its process lives, by each that compiles into the folder
_held: list[IO[str]] = []


def folder() -> Path:
    """Where this process finds and leaves compiled kernels."""
    return Path(os.environ[_VARIABLE])


def are_compiled(kernel: str = "*") -> bool:
    """Whether an earlier run left compiled kernels, or this one; the first compiles for a while."""
    return any(folder().rglob(f"*.{kernel}-*.nbi"))


def others() -> list[Path]:
    """Folders of other versions and machines beside this process's, the one used last first."""
    found = [path for path in folder().parent.glob("kernels-*") if path != folder()]
    with suppress(OSError):  # what another process removes meanwhile
        found.sort(key=_last_use, reverse=True)
    return found


def size_bytes(kernels: Path) -> int:
    """Of everything in a folder of kernels."""
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
        _hold(root / name)
    except OSError:  # a home folder may be read-only, and Numba stops where it cannot write
        root = Path(tempfile.gettempdir()) / f"splat-{_user()}"
        root.mkdir(mode=0o700, exist_ok=True)
        if _owner(root) != _user():  # compiled kernels are code: only our own may be run
            root = Path(tempfile.mkdtemp(prefix="splat-"))
        _hold(root / name)
    os.environ[_VARIABLE] = str(root / name)
    for path in others()[KEPT - 1 :]:
        with suppress(OSError):
            _remove(path)


def _digest() -> str:
    import llvmlite.binding as llvm

    processor = os.environ.get("NUMBA_CPU_NAME") or llvm.get_host_cpu_name()
    features = llvm.get_host_cpu_features().flatten()
    digest = hashlib.sha256("\n".join((sys.version, processor, features)).encode())
    digest.update((version("numba") + version("llvmlite")).encode())
    stages = Path(__file__).resolve().parent.parent
    for source in sorted(path for room in _ROOMS for path in (stages / room).rglob("*.py")):
        digest.update(source.relative_to(stages).as_posix().encode() + source.read_bytes())
    return digest.hexdigest()[:16]


def _root() -> Path:
    base = os.environ.get("XDG_CACHE_HOME") or os.environ.get("LOCALAPPDATA")
    return (Path(base) if base else Path("~/.cache").expanduser()) / "splat"


def _user() -> int:
    return os.getuid() if hasattr(os, "getuid") else 0


def _owner(path: Path) -> int:
    return path.stat().st_uid  # 0 under Windows, whose temporary folder is the user's own


def _hold(path: Path) -> None:
    """Make a folder of kernels, note the time, and keep it from being removed. Raises OSError."""
    for _ in range(2):  # another process may be removing this very folder
        path.mkdir(parents=True, exist_ok=True)
        file = (path / _IN_USE).open("w")
        file.write("kept while its process lives\n")
        file.flush()
        with suppress(OSError):  # not every disk of a network knows locks: then none is removed
            _lock(file, shared=True)
        if (path / _IN_USE).exists():
            break
    _held.append(file)


def _last_use(path: Path) -> float:
    note = path / _IN_USE
    return (note if note.exists() else path).stat().st_mtime


def _remove(path: Path) -> None:
    """Remove one folder of kernels. Raises OSError if a process holds it."""
    with (path / _IN_USE).open("a") as file:
        _lock(file, shared=False)
        if sys.platform != "win32":
            shutil.rmtree(path)
            return
    (path / _IN_USE).unlink()  # Windows refuses while anyone has it open
    shutil.rmtree(path)


def _lock(file: IO[str], shared: bool) -> None:
    """Shared locks wait; one for itself is refused (OSError) while any other is held."""
    if sys.platform == "win32":
        return
    import fcntl

    fcntl.flock(file, fcntl.LOCK_SH if shared else fcntl.LOCK_EX | fcntl.LOCK_NB)
