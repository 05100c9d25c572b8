"""Numbers in the JSON of files, checked before use: a file may come from anywhere."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.base.bad_files import BadFileError

_LARGEST = 1 << 53


def whole(holder: Any, key: str, default: int | None = None, most: int = _LARGEST) -> int:
    """The whole number at a key. Raises BadFileError if there is none from 0 to `most`."""
    value = holder.get(key, default)
    if type(value) is not int or not 0 <= value <= most:
        raise BadFileError(f"{key} is {str(value)[:40]}, wanted a whole number from 0 to {most}")
    return value


def numbers(holder: Any, key: str, count: int, default: Any = None) -> NDArray[np.float64]:
    """[count] the finite numbers at a key. Raises BadFileError if there is anything else."""
    array = np.array(holder.get(key, default), np.float64)
    if array.shape != (count,) or not np.isfinite(array).all():
        raise BadFileError(f"{key} is not {count} numbers")
    return array


def origin_of(asset: Any) -> NDArray[np.float64]:
    """[3] the origin that `origin_field` wrote; 0 if there is none."""
    return numbers(asset if isinstance(asset, dict) else {}, "splat_origin", 3, [0, 0, 0])


def origin_field(origin: NDArray[np.float64]) -> dict[str, list[float]]:
    """The entry for an origin [3]; none for 0."""
    return {"splat_origin": [float(v) for v in origin]} if origin.any() else {}
