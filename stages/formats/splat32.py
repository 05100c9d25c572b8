"""The 32-byte .splat of web viewers: small, without view-dependent colour.

Each record: position 3 x float32, standard deviations 3 x float32, RGBA 4 x uint8, quaternion
w, x, y, z as 4 x uint8 = 128 + 128 q. No header; axes as in memory (y down). Records are
sorted by volume x opacity, largest first, so that a viewer that is still loading shows the most.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stages.base.atomic import replacing
from stages.base.bad_files import BadFileError
from stages.base.row_slices import row_slices
from stages.formats.values import (
    LOG_SCALE_MIN,
    allocate,
    fill,
    linear_opacities,
    linear_scales,
    log_scales_of,
    logits_of,
    unit_quaternions,
)
from stages.scene import Splats, dc_to_rgb, rgb_to_dc

RECORD = np.dtype(
    [("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quaternion", "u1", 4)]
)


def order(splats: Splats) -> NDArray[np.intp]:
    """[N] rows by descending volume x opacity, with the opacity as rounded in the file, so that a
    reader finds the same order. The sort is stable."""
    logs = np.maximum(splats.log_scales, LOG_SCALE_MIN).sum(axis=1, dtype=np.float64)
    with np.errstate(divide="ignore"):
        size = logs + np.log(_alphas(splats), dtype=np.float64)
    return np.argsort(-size, kind="stable")


def _alphas(splats: Splats) -> NDArray[np.uint8]:
    return np.rint(255 * linear_opacities(splats)).astype(np.uint8)


def encode(splats: Splats) -> NDArray[np.void]:
    """[N] records in the order of the rows. All rows must be drawable."""
    records = np.zeros(len(splats), RECORD)
    records["mean"] = splats.means
    records["scale"] = linear_scales(splats)
    rgb = dc_to_rgb(splats.sh[:, 0].astype(np.float64))
    records["rgba"][:, :3] = np.rint(255 * np.clip(rgb, 0, 1))
    records["rgba"][:, 3] = _alphas(splats)
    records["quaternion"] = _encode_quaternions(unit_quaternions(splats.quaternions))
    return records


def _encode_quaternions(unit: NDArray[np.float32]) -> NDArray[np.uint8]:
    """q and -q are the same rotation, but 8 bits hold -1 exactly and +1 not; take the closer."""
    best = np.clip(np.rint(128 + 128 * unit), 0, 255)
    other = np.clip(np.rint(128 - 128 * unit), 0, 255)
    error = np.square((best - 128) / 128 - unit).sum(axis=1)
    other_error = np.square((other - 128) / 128 + unit).sum(axis=1)
    return np.where((other_error < error)[:, None], other, best).astype(np.uint8)


def decode(records: NDArray[np.void]) -> Splats:
    """The splats of the records, SH degree 0."""
    quaternions = (records["quaternion"].astype(np.float32) - 128) / 128
    quaternions[~quaternions.any(axis=1)] = (1, 0, 0, 0)  # four times 128: the identity
    rgba = records["rgba"].astype(np.float64) / 255
    return Splats(
        means=records["mean"].astype(np.float32),
        quaternions=unit_quaternions(quaternions),
        log_scales=log_scales_of(records["scale"]),
        opacity_logits=logits_of(rgba[:, 3]),
        sh=rgb_to_dc(rgba[:, None, :3]).astype(np.float32),
        sh_degrees=np.zeros(len(records), np.uint8),
    )


def write(path: Path, splats: Splats, *, units: str = "arbitrary") -> None:
    """Write `splats`.

    The format has no field for SH above degree 0, which is lost, and none for units and the
    origin; `formats.write` writes these beside it.
    Raises SplatError when the file cannot be written.
    """
    splats, places = splats.with_sh_degree(0), order(splats)
    with replacing(path) as temporary, temporary.open("wb") as file:
        for rows in row_slices(len(splats)):
            file.write(encode(splats.take(places[rows])).tobytes())


def read(path: Path) -> Splats:
    """The splats of a .splat. Raises BadFileError for other files."""
    size = path.stat().st_size
    if size % RECORD.itemsize:
        raise BadFileError(f"its {size} bytes are no multiple of {RECORD.itemsize}")
    splats = allocate(size // RECORD.itemsize, 0)
    with path.open("rb") as file:
        for rows in row_slices(len(splats)):
            fill(splats.take(rows), decode(np.fromfile(file, RECORD, rows.stop - rows.start)))
    return splats
