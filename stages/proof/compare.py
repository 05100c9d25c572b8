"""The differences between the values of a file and the splats that it was made from."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from stages.formats import BY_ENDING
from stages.formats.codecs import CODECS
from stages.proof.content import FileContent, arrays_by_rows
from stages.proof.matching import Rows, extent_of, matched_rows
from stages.scene import SH_C0, Splats
from stages.scene.flip import FLIP, flipped
from stages.scene.quantiles import median_spacing

_BLOCK = 1 << 14  # rows compared at a time: copies stay small however large the file is

# Errors that begin to be visible, to compare attributes: share of the scene's extent, natural
# logarithm, degrees, and one step of 8 bits.
_VISIBLE = {
    "position": 0.001,
    "log_scale": 0.02,
    "opacity": 1 / 255,
    "rotation": 1.0,
    "sh": 1 / 255 / SH_C0,
}
_ROUNDING = 0.01  # share of a visible error below which a difference is rounding
# Medians above these show a mistake, as no format loses so much: share of the extent, natural
# logarithm, 0..1, degrees, 0..1; for SH coefficients above degree 0 the squared error relative to
# their squares: 1 where they are missing, about 2 where they are unrelated.
_WRONG = {
    "position": 0.01,
    "log_scale": 0.5,
    "opacity": 0.1,
    "rotation": 10.0,
    "colour": 0.1,
    "sh": 1.1,
}
# Natural logarithm of the thinnest axis that looks unlike a flat splat, relative to the longest
# one: it is a pixel wide where the splat covers about 150 pixels. Formats differ in how thin an
# axis they hold, and flat splats have no thickness at all.
_THINNEST = -5.0
_ANISOTROPIC = 0.2  # a splat has an orientation if its log scales differ by this

# Changes of single splats that are worth a warning: of a position or a size by more than this share
# of the distance between neighbours, and then of a position by more than the splat's own size, of a
# size by this natural logarithm; of a colour by this much of 0..1, averaged over all directions.
_STEP, _RESIZED, _RECOLOURED = 0.25, 0.2, 0.1


@dataclass(frozen=True)
class Change:
    """How many splats look different in one attribute, and the largest difference among them:
    "position" in world units, "size" as a factor, "colour" in 0..1."""

    count: int
    largest: float


@dataclass(frozen=True)
class Differences:
    """Differences between a file and its original.

    Attributes:
        largest: by attribute; positions in world units, scales as natural logarithms (axes too thin
            to be seen count as just visible), opacities in 0..1, rotations in degrees, SH as
            stored.
        worst: the attribute with the most visible largest difference; "" if all are rounding.
        worst_row: its row in the file.
        wrong: by attribute that is wrong for most splats, its median error: positions as a share of
            the scene's extent, the others in the units of `largest`. Positions come alone, because
            without them rows cannot be matched. "sh": the squared error, relative to the squares.
        rows: [N] for each row of the file the row of the original.
        changes: by attribute in which splats look different.
    """

    largest: dict[str, float]
    worst: str
    worst_row: int
    wrong: dict[str, float]
    rows: Rows
    changes: dict[str, Change]


def differences(splats: Splats, content: FileContent, *names: str) -> Differences:
    """Compare a file with the `splats` that it should hold: as many, finite, in any order.

    names: the formats that either went through; some sort the rows or reduce the SH degree.
    """
    file = content.splats
    upright = content.world_from_file[1, 1] < 0
    placed = splats
    if upright:
        placed = replace(splats, means=splats.means * FLIP.astype(splats.means.dtype))
    rows = matched_rows(placed, file, _orders(placed, file, names))
    kept = [BY_ENDING[name].sh_degree for name in names]
    degree = min([max(splats.sh_degree, file.sh_degree), *kept])
    sums = np.zeros(3)

    def errors_of(block: slice) -> dict[str, NDArray[np.floating]]:
        a = splats.take(rows[block]).with_sh_degree(degree)
        b = file.take(block).with_sh_degree(degree)
        a = flipped(a) if upright else a
        pair = a.sh[:, 1:].astype(np.float64), b.sh[:, 1:].astype(np.float64)
        sums[:] += [np.square(x).sum() for x in (pair[0] - pair[1], *pair)]
        return _errors(a, b)

    errors = arrays_by_rows(len(file), errors_of, _BLOCK)
    return _summary(errors, sums, extent_of(splats), rows, _changes(errors, splats))


def _orders(truth: Splats, file: Splats, names: tuple[str, ...]) -> Iterator[Rows]:
    """The row orders in which a format may have written the original or the file. An iterator,
    because the first often fits."""
    for name in names:
        if order := CODECS[name].order:
            yield order(truth)
            yield np.argsort(order(file))


def _errors(a: Splats, b: Splats) -> dict[str, NDArray[np.floating]]:
    """By attribute, [N] the difference of each splat of the file, b, from the original, a."""
    thinnest = a.log_scales.astype(np.float64).max(axis=1, keepdims=True) + _THINNEST
    sizes = [np.maximum(s.log_scales, thinnest) for s in (a, b)]
    linear = [np.exp(logs.astype(np.float64)) for logs in sizes]
    colours = [np.clip(0.5 + SH_C0 * s.sh[:, 0].astype(np.float64), 0, 1) for s in (a, b)]
    change = np.square(a.sh[:, 1:].astype(np.float64) - b.sh[:, 1:]).sum(axis=1)
    return {
        "position": _largest_difference(a.means, b.means),
        "log_scale": _largest_difference(*sizes),
        "opacity": _largest_difference(a.opacities[:, None], b.opacities[:, None]),
        "rotation": rotation_angles(a.quaternions, b.quaternions),
        "sh": _largest_difference(*(s.sh.reshape(len(s), 3 * s.sh.shape[1]) for s in (a, b))),
        "colour": np.abs(colours[0] - colours[1]).max(axis=1, initial=0.0),
        "anisotropy": a.log_scales.max(axis=1) - a.log_scales.min(axis=1),
        "own_size": linear[0].max(axis=1),
        "size": _largest_difference(*linear),
        # the basis functions are orthonormal on the sphere, whose area is 4 pi
        "view_colour": np.sqrt(change.max(axis=1, initial=0.0) / (4 * np.pi)),
    }


def _changes(errors: dict[str, NDArray[np.floating]], splats: Splats) -> dict[str, Change]:
    """The errors of `splats` that are worth a warning; see `_errors`."""
    if not len(splats):
        return {}
    moved = errors["position"] > errors["own_size"]
    resized = errors["log_scale"] > _RESIZED
    if moved.any() or resized.any():
        step = _STEP * median_spacing(splats.means)
        moved &= errors["position"] > step
        resized &= (errors["size"] > step) & ~moved  # some formats scale what they move
    colour = np.maximum(errors["colour"], errors["view_colour"])
    found = {
        "position": (moved, errors["position"]),
        "size": (resized, np.exp(errors["log_scale"])),
        "colour": (colour > _RECOLOURED, colour),
    }
    return {
        name: Change(int(np.count_nonzero(rows)), float(values[rows].max()))
        for name, (rows, values) in found.items()
        if rows.any()
    }


def _largest_difference(a: NDArray[np.floating], b: NDArray[np.floating]) -> NDArray[np.float64]:
    """[N] largest difference in each row of [N, K]."""
    difference = np.abs(a.astype(np.float64) - b.astype(np.float64))
    return np.asarray(difference.max(axis=1, initial=0.0))


def rotation_angles(a: NDArray[np.floating], b: NDArray[np.floating]) -> NDArray[np.float64]:
    """[N] degrees between the rotations a and b [N, 4] of ellipsoids. Half turns about the axes of
    an ellipsoid do not change it, so the smallest of four rotations from a to b counts."""
    a, b = (q.astype(np.float64) for q in (a, b))
    a, b = (q / np.linalg.norm(q, axis=1, keepdims=True) for q in (a, b))
    real = (a * b).sum(axis=1, keepdims=True)
    imaginary = a[:, :1] * b[:, 1:] - b[:, :1] * a[:, 1:] - np.cross(a[:, 1:], b[:, 1:])
    between = np.sort(np.abs(np.concatenate([real, imaginary], axis=1)), axis=1)
    # The largest component is the cosine of half the angle; the sine is exact for small ones.
    sine = np.linalg.norm(between[:, :3], axis=1)
    return np.asarray(np.degrees(2 * np.arcsin(np.minimum(sine, 1))))


def _summary(
    errors: dict[str, NDArray[np.floating]],
    sums: NDArray[np.float64],
    extent: float,
    rows: Rows,
    changes: dict[str, Change],
) -> Differences:
    if not len(rows):
        return Differences(_named(dict.fromkeys(_VISIBLE, 0.0)), "", 0, {}, rows, {})
    largest = {name: float(errors[name].max()) for name in _VISIBLE}
    units = {**_VISIBLE, "position": _VISIBLE["position"] * extent}
    worst = max(_VISIBLE, key=lambda name: largest[name] / units[name])
    shows = largest[worst] > _ROUNDING * units[worst]
    row = int(errors[worst].argmax()) if shows else 0
    typical = {name: float(np.median(errors[name])) for name in _WRONG if name != "sh"}
    typical["position"] /= extent
    long = errors["anisotropy"] > _ANISOTROPIC
    typical["rotation"] = float(np.median(errors["rotation"][long])) if long.any() else 0.0
    typical["sh"] = float(sums[0] / max(sums[1], sums[2], 1e-30))
    wrong = {name: error for name, error in typical.items() if error > _WRONG[name]}
    if "position" in wrong:
        wrong = {"position": wrong["position"]}
    return Differences(_named(largest), worst if shows else "", row, wrong, rows, changes)


def _named(largest: dict[str, float]) -> dict[str, float]:
    """With units in the names, rounded to three digits."""
    names = {"rotation": "max_rotation_error_degrees"}
    return {
        names.get(name, f"max_{name}_error"): float(f"{value:.3g}")
        for name, value in largest.items()
    }
