"""Diagnosis of a wrong file: which common writer error explains the differences.

A wrong order of axes, quaternion components or SH coefficients looks consistent to every reader and
only shows in comparison with the original. Each error is tried, and one that fits is named.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable

import numpy as np

from stages.proof.compare import Differences, rotation_angles
from stages.proof.content import FileContent
from stages.proof.matching import extent_of
from stages.scene import Splats
from stages.scene.flip import FLIP, flipped

_ATTRIBUTE_NAMES = {
    "position": "positions",
    "log_scale": "sizes",
    "opacity": "opacities",
    "rotation": "rotations",
    "colour": "colours",
    "sh": "view-dependent colours",
}
_SAMPLE = 20_000  # splats that a hypothesis is tested on
_FITS_EXTENT = 0.02
_FITS_DEGREES = 3.0
_FITS_ENERGY = 0.3  # share of the squared coefficients
_QUANTILES = np.linspace(3, 97, 33)


def explain(splats: Splats, content: FileContent, found: Differences) -> str:
    """What is wrong with most splats of a file, and the likely error; "" if nothing is."""
    if not found.wrong:
        return ""
    if "position" in found.wrong:  # rows cannot be matched then, and all else differs
        return _with_cause("most positions are wrong", _axes(splats, content))
    what = f"most {' and '.join(_ATTRIBUTE_NAMES[name] for name in found.wrong)} are wrong"
    rows = np.arange(0, len(splats), max(1, len(splats) // _SAMPLE))
    truth, file = splats.take(found.rows[rows]), content.splats.take(rows)
    pairs = [(truth, file)]
    if content.world_from_file[1, 1] < 0:  # the error was made after the turn to y up, or before
        pairs = [(flipped(truth), file), (truth, flipped(file))]
    for tried, name in ((_quaternions, "rotation"), (_sh, "sh")):
        if name in found.wrong:
            what = _with_cause(what, next(filter(None, (tried(*pair) for pair in pairs)), ""))
    return what


def _with_cause(what: str, cause: str) -> str:
    return f"{what}: {cause}" if cause else what


def _axes(splats: Splats, content: FileContent) -> str:
    """The permutation, scale or offset of positions that fits; "" if none does. Uses quantiles on
    each axis, so the order of the rows does not matter."""
    means = splats.means * (FLIP if content.world_from_file[1, 1] < 0 else np.ones(3))
    wanted = np.percentile(means, _QUANTILES, axis=0)
    given = np.percentile(content.splats.means, _QUANTILES, axis=0)
    extent = extent_of(splats)
    tried = []
    for axes in itertools.permutations(range(3)):
        for signs in itertools.product((1, -1), repeat=3):
            pairs = list(zip(axes, signs, strict=True))
            # the quantiles of -x are those of x, negated and from the other end
            guess = [wanted[:, axis] if sign > 0 else -wanted[::-1, axis] for axis, sign in pairs]
            words = ", ".join("-" * (sign < 0) + "xyz"[axis] for axis, sign in pairs)
            tried.append((words, float(np.abs(np.stack(guess, axis=1) - given).max())))
    if best := _first_below(_FITS_EXTENT * extent, tried):
        return "" if best == "x, y, z" else f"its x, y, z look like {best}"
    # neither permuted nor mirrored: moved, or scaled
    times = float(np.ptp(given, axis=0).sum() / max(float(np.ptp(wanted, axis=0).sum()), 1e-30))
    moved = np.median(given - times * wanted, axis=0)
    if float(np.abs(given - times * wanted - moved).max()) > _FITS_EXTENT * extent * times:
        return ""
    if abs(times - 1) > _FITS_EXTENT:
        return f"the scene is {times:.3g} times as large"
    steps = np.round(moved / extent, 3) * extent + 0.0
    return f"all are moved by {', '.join(f'{value:.3g}' for value in steps)}"


def _quaternions(truth: Splats, file: Splats) -> str:
    q = file.quaternions
    tried = (
        ("they look like x, y, z, w taken for w, x, y, z", np.roll(q, 1, axis=1)),
        ("they look like w, x, y, z taken for x, y, z, w", np.roll(q, -1, axis=1)),
        ("they look like their inverses", q * np.array([1, -1, -1, -1], q.dtype)),
    )
    return _first_below(
        _FITS_DEGREES,
        (
            (words, float(np.median(rotation_angles(truth.quaternions, guess))))
            for words, guess in tried
        ),
    )


def _sh(truth: Splats, file: Splats) -> str:
    degree = max(truth.sh_degree, file.sh_degree)
    right, given = (s.with_sh_degree(degree).sh[:, 1:].astype(np.float64) for s in (truth, file))
    n = len(given)
    tried = [
        (
            "they look as if not rotated with the axes",
            flipped(file).with_sh_degree(degree).sh[:, 1:],
        )
    ]
    # a reader may have allocated a higher degree than the file holds
    for width in {(d + 1) ** 2 - 1 for d in range(1, degree + 1)}:
        part, rest = given[:, :width], np.zeros_like(given[:, width:])
        interleaved = part.transpose(0, 2, 1).reshape(n, width, 3)
        planar = part.reshape(n, 3, width).transpose(0, 2, 1)
        for words, guess in (
            ("coefficient-major (RGB together), read as channel-major", interleaved),
            ("channel-major (all of red first), read as coefficient-major", planar),
        ):
            tried.append((f"the coefficients look like {words}", np.concatenate([guess, rest], 1)))
    energy = max(float(np.square(right).sum()), 1e-30)
    return _first_below(
        _FITS_ENERGY,
        ((words, float(np.square(guess - right).sum()) / energy) for words, guess in tried),
    )


def _first_below(bound: float, found: Iterable[tuple[str, float]]) -> str:
    words, value = min(found, key=lambda pair: pair[1])
    return words if value < bound else ""
