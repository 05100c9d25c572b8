"""How far the values of a file lie from the splats that it was made from."""

from __future__ import annotations

import importlib

import numpy as np
from numpy.typing import NDArray

from stages.formats import FORMATS
from stages.formats.turn import turned
from stages.formats.verify import FileContent
from stages.scene import Splats


def largest_errors(splats: Splats, content: FileContent, name: str) -> dict[str, float]:
    """Largest differences of the values, row by row; three digits each.

    splats: what was written, as `rows.kept_rows` leaves them. name: of the format; some sort the
    rows. Positions in world units, scales in natural logarithms, opacities in 0..1.
    """
    if content.world_from_file[1, 1] < 0:
        splats = turned(splats)
    order = getattr(importlib.import_module(f"stages.formats.{FORMATS[name]}"), "order", None)
    if order is not None:
        splats = splats.take(order(splats))
    if name == "splat":
        splats = splats.with_sh_degree(0)
    file = content.splats.with_sh_degree(splats.sh_degree)
    return {
        "max_position_error": _largest(splats.means, file.means),
        "max_log_scale_error": _largest(splats.log_scales, file.log_scales),
        "max_opacity_error": _largest(splats.opacities, file.opacities),
        "max_rotation_error_degrees": _rotation(splats.quaternions, file.quaternions),
        "max_sh_error": _largest(splats.sh, file.sh),
    }


def _largest(a: NDArray[np.floating], b: NDArray[np.floating]) -> float:
    difference = np.abs(a.astype(np.float64) - b.astype(np.float64))
    return float(f"{difference.max(initial=0.0):.3g}")


def _rotation(a: NDArray[np.floating], b: NDArray[np.floating]) -> float:
    """Degrees between rotations [N, 4]."""
    a, b = (q.astype(np.float64) for q in (a, b))
    a /= np.linalg.norm(a, axis=1, keepdims=True)
    b /= np.linalg.norm(b, axis=1, keepdims=True)
    # |a - b| = 2 sin(angle / 4): exact for small angles, where the arc cosine is not
    apart = np.minimum(np.linalg.norm(a - b, axis=1), np.linalg.norm(a + b, axis=1))
    degrees = np.degrees(4 * np.arcsin(np.minimum(apart / 2, 1)))
    return float(f"{degrees.max(initial=0.0):.3g}")
