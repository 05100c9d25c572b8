"""Numbers, places and answers in files, checked before use: a file may come from anywhere."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.base.bad_files import BadFileError
from stages.scene import Splats
from stages.scene.place import EarthPlace

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


def agreed(said: Iterable[bool], message: str) -> bool:
    """What all places of a file say that say anything; False if none does. Raises BadFileError
    `message` if they disagree."""
    answers = set(said)
    if len(answers) > 1:
        raise BadFileError(message)
    return True in answers


def located(splats: Splats, holder: Any) -> Splats:
    """The splats, their positions as a file stores them, with the origin and the place that
    `location_fields` wrote into `holder`. Raises BadFileError."""
    fields = holder if isinstance(holder, Mapping) else {}
    origin = numbers(fields, "splat_origin", 3, [0, 0, 0])
    place = place_of(fields.get("splat_place"), origin)
    return replace(splats, origin=origin, place=place)


def location_fields(origin: NDArray[np.float64], place: EarthPlace | None) -> dict[str, Any]:
    """What a file says of where it lies: nothing for the origin 0 and no place.

    Args:
        origin: [3] as in `Splats`, in the axes of the file.
        place: as in `Splats`, of the file's axes. The file holds the place of its own positions, so
            that who reads it needs no origin.
    """
    fields: dict[str, Any] = {}
    if origin.any():
        fields["splat_origin"] = [float(v) for v in origin]
    if place is not None:
        fields["splat_place"] = place.beside(origin).to_json()
    return fields


def place_of(stated: Any, origin: NDArray[np.float64]) -> EarthPlace | None:
    """The place of a world whose positions, less `origin` [3], lie where the file has `stated`.
    Raises BadFileError."""
    if stated is None:
        return None
    try:
        return EarthPlace.from_json(stated).beside(-origin)
    except ValueError as error:
        raise BadFileError(str(error)) from error
