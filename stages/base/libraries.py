"""Which versions of which libraries made an output."""

from __future__ import annotations

import platform
import re
from functools import cache
from importlib.metadata import PackageNotFoundError, distribution, requires, version
from pathlib import PurePosixPath

_SPLAT = "splat"


def needed() -> tuple[str, ...]:
    """Names of the distributions that splat depends on, as its own metadata says; () if it runs
    from a folder of sources that was never installed."""
    try:
        lines = requires(_SPLAT) or []
    except PackageNotFoundError:
        return ()
    always = (line for line in lines if not re.search(r"\bextra\s*==", line))
    return tuple(re.split(r"[^\w.-]", line, maxsplit=1)[0] for line in always)


def modules_of(name: str) -> tuple[str, ...]:
    """What a distribution installs to be imported: ("cv2",) for OpenCV. () if it is missing."""
    try:
        files = distribution(name).files or []
    except PackageNotFoundError:
        return ()
    packages = {
        PurePosixPath(file).parts[0].removesuffix(".py")
        for file in files
        if len(file.parts) <= 2 and PurePosixPath(file).name in ("__init__.py", file.parts[0])
    }
    return tuple(sorted(p for p in packages if p.isidentifier() and not p.startswith("_")))


@cache
def versions() -> dict[str, str]:
    """Installed versions by distribution name; missing ones left out. Imports none of them."""
    found = {"python": platform.python_version()}
    for name in (_SPLAT, *needed()):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found
