"""Checks of splat values, and conversion between our encodings and linear values."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.base import scratch
from stages.base.bad_files import BadFileError
from stages.base.errors import SplatError
from stages.base.row_slices import row_slices
from stages.raster.definition import LOG_SCALE_MAX, QUATERNION_MIN
from stages.scene import ROW_FIELDS, Splats

LOG_SCALE_MIN = -87.0  # below it a scale is not a normal float32
# The logits of opacities 0 and 1. Alpha is drawn between 1/255 and 0.99, so both look exact.
LOGIT_MIN, LOGIT_MAX = -88.0, 17.0

_allows_nonfinite: ContextVar[bool] = ContextVar("allows_nonfinite", default=False)


@contextmanager
def nonfinite_allowed() -> Iterator[None]:
    """A context in which readers return values that are not finite instead of refusing the file."""
    token = _allows_nonfinite.set(True)
    try:
        yield
    finally:
        _allows_nonfinite.reset(token)


def allows_nonfinite() -> bool:
    return _allows_nonfinite.get()


def drawable_rows(splats: Splats) -> NDArray[np.bool_]:
    """[N] whether a splat can be drawn: all values are finite, the squared scales fit float32 and
    the quaternion can be normalised. This is the rule of our rasteriser."""
    good = np.empty(len(splats), bool)
    for rows in row_slices(len(splats)):
        good[rows] = _drawable(splats.take(rows))
    return good


def _drawable(splats: Splats) -> NDArray[np.bool_]:
    with np.errstate(invalid="ignore", over="ignore"):
        good = np.isfinite(splats.means).all(axis=1)
        good &= np.abs(splats.means).max(axis=1, initial=0.0) <= np.finfo(np.float32).max
        good &= np.isfinite(splats.log_scales).all(axis=1)
        good &= splats.log_scales.max(axis=1, initial=-np.inf) <= LOG_SCALE_MAX
        good &= np.isfinite(splats.opacity_logits)
        good &= np.isfinite(splats.sh).all(axis=(1, 2))
        good &= np.abs(splats.sh).max(axis=(1, 2), initial=0.0) <= np.finfo(np.float32).max
        largest = np.abs(splats.quaternions.astype(np.float64)).max(axis=1, initial=0.0)
        good &= np.isfinite(largest) & (largest >= QUATERNION_MIN)
    return np.asarray(good, bool)


def drop_undrawable(splats: Splats) -> tuple[Splats, int]:
    """(the drawable splats, the number of others)."""
    kept = select_rows(splats, drawable_rows(splats))
    return kept, len(splats) - len(kept)


def nothing_drawable(path: Path, dropped: int) -> SplatError:
    """The error for a file in which no splat can be drawn."""
    return SplatError(
        "nothing-drawable",
        given=f"None of the {dropped:,} splats of {path} can be drawn.",
        wanted="Finite values, rotations that are not 0, and sizes whose squares fit 32 bits.",
        hint="`splat info` says what is wrong with them.",
    )


def select_rows(splats: Splats, keep: NDArray[np.bool_]) -> Splats:
    """The rows where `keep` [N] is true."""
    if keep.all():
        return splats
    arrays = empty_rows(splats, int(keep.sum()))
    start = 0
    for rows in row_slices(len(splats)):
        mask = keep[rows]
        there = slice(start, start + int(mask.sum()))
        for name, values in arrays.items():
            values[there] = getattr(splats, name)[rows][mask]
        start = there.stop
    return replace(splats, **arrays)


def empty_rows(like: Splats, count: int) -> dict[str, Any]:
    """Arrays for `count` splats of the types and SH degree of `like`, by field."""
    every = {name: getattr(like, name) for name in ROW_FIELDS}
    return {name: scratch.empty((count, *a.shape[1:]), a.dtype) for name, a in every.items()}


def _by_blocks(
    values: NDArray[np.floating], change: Callable[[NDArray[np.float64]], NDArray[np.floating]]
) -> NDArray[np.float32]:
    """`change` of the `values` in float64, as float32 of the same shape."""
    out = np.empty(values.shape, np.float32)
    for rows in row_slices(len(values)):
        out[rows] = change(values[rows].astype(np.float64))
    return out


def unit_quaternions(quaternions: NDArray[np.floating]) -> NDArray[np.float32]:
    """[N, 4] normalised w, x, y, z. The norm is computed in float64, where 1e-20 squared is not
    0."""
    return _by_blocks(quaternions, lambda q: q / np.linalg.norm(q, axis=1, keepdims=True))


def linear_scales(splats: Splats) -> NDArray[np.float32]:
    """[N, 3] standard deviations, at least the smallest normal float32, so that the logarithm is
    reversible."""
    return _by_blocks(splats.log_scales, lambda logs: np.exp(np.maximum(logs, LOG_SCALE_MIN)))


def linear_opacities(splats: Splats) -> NDArray[np.float32]:
    """[N] opacities in [0, 1]."""
    with np.errstate(over="ignore"):
        return (1.0 / (1.0 + np.exp(-splats.opacity_logits.astype(np.float64)))).astype(np.float32)


def logits_of(opacities: NDArray[np.floating]) -> NDArray[np.float32]:
    """[N] the inverse of `linear_opacities`. Raises BadFileError for values outside [0, 1]."""

    def logits(p: NDArray[np.float64]) -> NDArray[np.float64]:
        if not ((p >= 0) & (p <= 1)).all() and not allows_nonfinite():
            raise BadFileError("opacities lie outside 0..1")
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(np.clip(np.log(p) - np.log1p(-p), LOGIT_MIN, LOGIT_MAX))

    return _by_blocks(opacities, logits)


def log_scales_of(scales: NDArray[np.floating], factor: float = 1.0) -> NDArray[np.float32]:
    """[N, 3] the inverse of `linear_scales`, for `scales` times `factor`. Scales of 0, of flat
    splats, become the smallest normal float32. Raises BadFileError for negative scales."""

    def logs(exact: NDArray[np.float64]) -> NDArray[np.float64]:
        if not (exact >= 0).all() and not allows_nonfinite():
            raise BadFileError("scales are negative or not numbers")
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.maximum(np.log(exact * factor), LOG_SCALE_MIN)

    return _by_blocks(scales, logs)


def allocate(count: int, degree: int) -> Splats:
    """`count` uninitialised float32 splats of an SH degree, for a reader to fill."""
    return Splats(
        means=scratch.empty((count, 3)),
        quaternions=scratch.empty((count, 4)),
        log_scales=scratch.empty((count, 3)),
        opacity_logits=scratch.empty((count,)),
        sh=scratch.empty((count, (degree + 1) ** 2, 3)),
        sh_degrees=np.zeros(count, np.uint8),
    )


def fill(out: Splats, values: Splats) -> None:
    """Copy all values but the degrees into `out`, which are views of some rows."""
    for name in ROW_FIELDS[:-1]:
        getattr(out, name)[:] = getattr(values, name)


def sh_degrees_used(sh: NDArray[np.floating]) -> NDArray[np.uint8]:
    """[N] the highest degree with a nonzero coefficient in `sh` [N, (L + 1)^2, 3]."""
    degrees = np.zeros(len(sh), np.uint8)
    for rows in row_slices(len(sh)):
        for degree in range(1, round(sh.shape[1] ** 0.5)):
            coefficients = sh[rows, degree * degree : (degree + 1) ** 2]
            degrees[rows][(coefficients != 0).any(axis=(1, 2))] = degree
    return degrees


def check_finite(splats: Splats) -> Splats:
    """The result of a reader. Infinite opacity logits and log scales, which files hold for opaque
    and flat splats, become finite in place, and the SH degree of each splat is found.

    Raises BadFileError if any other value is not finite: such a file is damaged.
    """
    for rows in row_slices(len(splats)):
        logits, logs = splats.opacity_logits[rows], splats.log_scales[rows]
        flat, opaque = np.isneginf(logs), np.isinf(logits)
        logs[flat] = LOG_SCALE_MIN
        logits[opaque] = np.clip(logits[opaque], LOGIT_MIN, LOGIT_MAX)
        np.clip(logits, -1e30, 1e30, out=logits)
    clean = replace(splats, sh_degrees=sh_degrees_used(splats.sh))
    for name in (*ROW_FIELDS[:-1], "origin"):
        values = getattr(clean, name)
        bad = sum(int((~np.isfinite(values[rows])).sum()) for rows in row_slices(len(values)))
        if bad and not allows_nonfinite():
            raise BadFileError(f"{bad} values of {name} are not finite numbers")
    return clean


def concatenate(parts: Sequence[Splats]) -> Splats:
    """All rows of `parts`, at the highest SH degree among them, with the origin 0 and no
    place."""
    if len(parts) == 1:
        return replace(parts[0], origin=np.zeros(3), place=None)
    if not parts:
        return allocate(0, 0)
    arrays = empty_rows(max(parts, key=lambda part: part.sh_degree), sum(map(len, parts)))
    start = 0
    for part in parts:
        for rows in row_slices(len(part)):
            for name, every in arrays.items():
                values = getattr(part, name)[rows]
                out = every[start + rows.start : start + rows.stop]
                if name == "sh":
                    out[:, values.shape[1] :] = 0
                    out = out[:, : values.shape[1]]
                out[...] = values
        start += len(part)
    return Splats(**arrays, draw_settings=parts[0].draw_settings)
