"""The conditions of `--keep`: comparisons with numbers, joined by "and"."""

from __future__ import annotations

import operator
import re
from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from stages.base.errors import SplatError, UsageError
from stages.scene import Splats, dc_to_rgb

Column = Callable[[Splats], NDArray[np.floating]]
VARIABLES: Mapping[str, Column] = {
    "x": lambda splats: splats.means[:, 0],
    "y": lambda splats: splats.means[:, 1],
    "z": lambda splats: splats.means[:, 2],
    "opacity": lambda splats: splats.opacities,
    "scale": lambda splats: np.exp(splats.log_scales.max(axis=1)),
    "thickness": lambda splats: np.exp(splats.log_scales.min(axis=1)),
    "red": lambda splats: dc_to_rgb(splats.sh[:, 0, 0]),
    "green": lambda splats: dc_to_rgb(splats.sh[:, 0, 1]),
    "blue": lambda splats: dc_to_rgb(splats.sh[:, 0, 2]),
    "degree": lambda splats: splats.sh_degrees.astype(np.float64),
}
_COMPARISONS = {
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
    "==": operator.eq,
    "!=": operator.ne,
}
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?"
_COMPARISON = re.compile(rf"\s*([a-z]+)\s*([<>=!]=|[<>])\s*({_NUMBER})\s*", re.ASCII)


def parse_expression(text: str) -> Callable[[Splats], NDArray[np.bool_]]:
    """The condition of `text`: for N splats [N] whether it is true; false where a value is NaN,
    but for "!=". Raises SplatError "edit-keep" for what is no condition."""
    comparisons = []
    for part in re.split(r"\sand\s", text):
        match = _COMPARISON.fullmatch(part)
        if match is None or match[1] not in VARIABLES:
            why = "is not understood" if match is None else f"names {match[1]}, which splats lack"
            raise _wrong(text, f"{part.strip()[:60]!r} {why}")
        comparisons.append((VARIABLES[match[1]], _COMPARISONS[match[2]], float(match[3])))

    def condition(splats: Splats) -> NDArray[np.bool_]:
        kept = np.ones(len(splats), bool)
        for column, compare, number in comparisons:
            kept &= compare(column(splats).astype(np.float64), number)
        return kept

    return condition


def _wrong(text: str, why: str) -> SplatError:
    return UsageError(
        "edit-keep",
        given=f"--keep {text[:100]!r}: {why}.",
        wanted=f"Comparisons (< <= > >= == !=) of {', '.join(VARIABLES)} with numbers, and between "
        "them.",
        hint="For example: --keep 'opacity > 0.1 and scale < 0.5'",
    )
