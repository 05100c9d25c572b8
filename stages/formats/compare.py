"""How far the values of a file lie from the splats that it was made from."""

from __future__ import annotations

import importlib

import numpy as np
from numpy.typing import NDArray

from stages.formats import FORMATS
from stages.formats.blocks import block_of, passing
from stages.formats.turn import turned
from stages.formats.verify import FileContent
from stages.scene import Splats

_NAMES = (
    "max_position_error",
    "max_log_scale_error",
    "max_opacity_error",
    "max_rotation_error_degrees",
    "max_sh_error",
)


def largest_errors(splats: Splats, content: FileContent, name: str) -> dict[str, float]:
    """Largest differences of the values, row by row; three digits each.

    splats: what was written, as `rows.kept_rows` leaves them. name: of the format; some sort the
    rows. Positions in world units, scales in natural logarithms, opacities in 0..1.
    """
    module = importlib.import_module(f"stages.formats.{FORMATS[name]}")
    order = module.order(splats) if hasattr(module, "order") else None
    if name == "splat":
        splats = splats.with_sh_degree(0)
    worst: dict[str, float] = dict.fromkeys(_NAMES, 0.0)
    for rows in passing(len(splats)):
        mine, theirs = block_of(splats, rows, order), block_of(content.splats, rows)
        if content.world_from_file[1, 1] < 0:
            mine = turned(mine)
        theirs = theirs.with_sh_degree(splats.sh_degree)
        errors = (
            _largest(mine.means, theirs.means),
            _largest(mine.log_scales, theirs.log_scales),
            _largest(mine.opacities, theirs.opacities),
            _rotation(mine.quaternions, theirs.quaternions),
            _largest(mine.sh, theirs.sh),
        )
        # NaN stays: a comparison with it would lose it
        worst = {k: float(np.maximum(worst[k], e)) for k, e in zip(_NAMES, errors, strict=True)}
    return {name: float(f"{value:.3g}") for name, value in worst.items()}


def _largest(a: NDArray[np.floating], b: NDArray[np.floating]) -> float:
    difference = np.abs(a.astype(np.float64) - b.astype(np.float64))
    return float(difference.max(initial=0.0))


def _rotation(a: NDArray[np.floating], b: NDArray[np.floating]) -> float:
    """Degrees between rotations [N, 4]."""
    a, b = (q.astype(np.float64) for q in (a, b))
    a /= np.linalg.norm(a, axis=1, keepdims=True)
    b /= np.linalg.norm(b, axis=1, keepdims=True)
    # |a - b| = 2 sin(angle / 4): exact for small angles, where the arc cosine is not
    apart = np.minimum(np.linalg.norm(a - b, axis=1), np.linalg.norm(a + b, axis=1))
    degrees = np.degrees(4 * np.arcsin(np.minimum(apart / 2, 1)))
    return float(degrees.max(initial=0.0))
