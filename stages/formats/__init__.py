"""One module a file format: read and write, nothing else.

`write` takes splats in our own conventions (y down, ln scales, logit opacity) and `read` gives
them back so; each format's own axes and units of measure stay inside its module.
"""

from __future__ import annotations

import importlib
from contextlib import nullcontext
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

from stages.base.errors import Family, SplatError

if TYPE_CHECKING:
    from stages.scene import Splats, View

# What a file's name ends in, without the dot -> module.
FORMATS = {
    "ply": "ply",
    "splat": "splat32",
    "glb": "gltf",
    "usdz": "usd",
    "gltf": "gltf",
    "quantised.glb": "gltf_quantised",
    "usda": "usd",
    "usdc": "usd",
    "compressed.ply": "compressed_ply",
    "spz": "spz",
    "sog": "sog",
    "html": "html",
}
# Those that hold less than float32, and what of: smaller, and not the same splats any more.
LOSSY = {
    "splat": "has 8-bit colours that do not change with the view",
    "quantised.glb": "has rotations, sizes and opacities of 16 bits",
    "compressed.ply": "has positions and sizes of 10 and 11 bits, and 8-bit colours",
    "spz": "has sizes in steps of 6 %, 8-bit colours and view-dependent colour of 4 and 5 bits",
    "sog": "has 256 sizes and colours, and a palette of view-dependent colours",
}


def format_of(path: Path) -> str:
    """The format that the end of the name says. Raises SplatError "format-unknown" for another."""
    name = Path(path).name.lower()
    endings = [known for known in FORMATS if name.endswith("." + known)]
    if not endings:
        raise SplatError(
            "format-unknown",
            given=f"{path} has the suffix {Path(path).suffix!r}.",
            wanted=f"One of {', '.join('.' + known for known in FORMATS)}.",
            hint="Choose a name with one of these suffixes.",
            family=Family.USAGE,
        )
    return max(endings, key=len)


def write(
    path: Path, splats: Splats, *, units: str = "arbitrary", views: tuple[View, ...] = ()
) -> int:
    """Write `splats` in the format that the suffix of `path` names, whole or not at all; return
    how many could not be drawn (values not finite, or too large) and were left out.

    units: "metres" or "arbitrary", noted in the formats that can carry it.
    views: cameras in the frame of `splats.means` to look from, for the format that shows itself.
    Raises SplatError "format-unknown", or what keeps the file from being written.
    """
    more = {"views": views} if format_of(path) == "html" else {}
    dropped: int = _module(path).write(Path(path), splats, units=units, **more)
    return dropped


def read(path: Path, *, strict: bool = True) -> Splats:
    """The splats of a file, float32, y down.

    strict: whether a value that is not finite makes the file unreadable. Raises SplatError
    "format-unknown" or "splats-unreadable".
    """
    from stages.formats.rows import damage_kept

    module = _module(path)
    with nullcontext() if strict else damage_kept():
        splats: Splats = module.read(Path(path))
    return splats


def _module(path: Path) -> ModuleType:
    return importlib.import_module(f"stages.formats.{FORMATS[format_of(path)]}")
