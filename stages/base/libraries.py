"""Which versions of which libraries made an output."""

from __future__ import annotations

import platform
from functools import cache
from importlib.metadata import PackageNotFoundError, version

NAMES = (
    "splat",
    "av",
    "fast-simplification",
    "numba",
    "numpy",
    "opencv-contrib-python-headless",
    "pillow",
    "pillow-heif",
    "pycolmap",
    "pygltflib",
    "plyfile",
    "scikit-image",
    "scipy",
    "torch",
    "usd-core",
)


@cache
def versions() -> dict[str, str]:
    """Installed versions by distribution name; missing ones left out. Imports none of them."""
    found = {"python": platform.python_version()}
    for name in NAMES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found
