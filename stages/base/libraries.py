"""The versions of the libraries that made an output."""

from __future__ import annotations

import platform
import re
from functools import cache
from importlib.metadata import PackageNotFoundError, distribution, requires, version
from pathlib import PurePosixPath

from stages.base.distribution import NAME, VERSION


def needed() -> tuple[str, ...]:
    """Names of the distributions that the project needs, without its extras. One that only some
    versions of Python or systems need is named where it is installed.

    They come from the installed metadata; () in a checkout that was never installed.
    """
    try:
        lines = requires(NAME) or []
    except PackageNotFoundError:
        return ()
    always = [line for line in lines if not re.search(r"\bextra\s*==", line)]
    names = [re.split(r"[^\w.-]", line, maxsplit=1)[0] for line in always]
    both = zip(names, always, strict=True)
    return tuple(name for name, line in both if ";" not in line or modules_of(name))


def modules_of(name: str) -> tuple[str, ...]:
    """The modules that a distribution installs: ("cv2",) for OpenCV. () if it is missing."""
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
    """Versions by distribution name, with Python's and the project's own; missing ones are left
    out. No library is imported."""
    version_of = {"python": platform.python_version(), NAME: VERSION}
    for name in needed():
        try:
            version_of[name] = version(name)
        except PackageNotFoundError:
            continue
    return version_of
