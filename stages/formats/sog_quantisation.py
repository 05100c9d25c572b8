"""Quantisation of splats to fewer bits, for formats that compress repeated values.

Values are rounded to a coarser subset of the grid of the format, so that they compress better. Its
writer and its readers stay unchanged.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace

import numpy as np
from numpy.typing import NDArray

from stages.formats import codebook, smallest_three
from stages.formats.axes import smallest_rotations
from stages.formats.format_table import Format
from stages.formats.sog import (
    LOG_SCALE_LIMIT,
    STEPS,
    palette_of,
    palette_size,
    position_range,
    symmetric_log,
)
from stages.formats.sog_read import symmetric_exp
from stages.formats.values import (
    drop_undrawable,
    linear_opacities,
    logits_of,
    sh_degrees_used,
    unit_quaternions,
)
from stages.scene import QuantisedSplats, Splats


@dataclass(frozen=True)
class BitDepths:
    """Bits of each value, and of a label in the palette of SH coefficients."""

    position: int = 16
    rotation: int = 8
    scale: int = 8
    colour: int = 8
    opacity: int = 8
    palette: int = 16


def quantise_for_sog(splats: Splats, bits: BitDepths) -> Splats:
    """The splats as a .sog of these bit depths holds them."""
    return quantise_splats(smallest_rotations(splats), bits)


def quantise_splats(splats: Splats, bits: BitDepths) -> Splats:
    """As `quantise_for_sog`, without permuting the axes of the ellipsoids."""
    exact = quantised = splats
    for name, count in asdict(bits).items():
        quantised = quantise_attribute(exact, quantised, name, count)
    return quantised


def quantise_attribute(exact: Splats, splats: Splats, name: str, bits: int) -> Splats:
    """`splats` with one attribute, a field of `BitDepths`, quantised from its value in `exact`."""
    if not len(exact):
        return splats
    if name == "position":
        return replace(splats, means=_positions(exact.means, bits))
    if name == "rotation":
        return replace(splats, quaternions=_rotations(exact.quaternions, bits))
    if name == "scale":
        logs = np.clip(exact.log_scales, -LOG_SCALE_LIMIT, LOG_SCALE_LIMIT)
        return replace(splats, log_scales=_by_codebook(logs, bits))
    if name == "opacity":
        return replace(splats, opacity_logits=_opacities(exact, bits))
    sh = splats.sh.copy()
    if name == "colour":
        sh[:, 0] = _by_codebook(exact.sh[:, 0], bits)
    elif sh.shape[1] > 1:
        sh[:, 1:] = _by_palette(exact.sh[:, 1:], bits)
    return replace(splats, sh=sh, sh_degrees=sh_degrees_used(sh))


def palette_bits(count: int) -> int:
    """The bits of a label in the largest palette for `count` splats."""
    return (palette_size(count) - 1).bit_length()


def splats_to_write(row: Format, quantised: QuantisedSplats) -> Splats:
    """The splats that a file of this format should hold: drawable, quantised to the chosen bit
    depths, and with view-averaged colours where the format has no SH above degree 0."""
    if row.ending in quantised.finetuned:
        return quantised.finetuned[row.ending]
    splats = quantised.splats
    if quantised.plain is not None and not row.holds_antialiased(quantised.drawing):
        splats = quantised.plain
    if not row.sh_degree and quantised.flat_dc is not None:
        sh = quantised.flat_dc[:, None].astype(splats.sh.dtype)
        splats = replace(splats.with_sh_degree(0), sh=sh)
    splats = drop_undrawable(splats)[0]
    if not row.has_bit_depths or quantised.sog_bits is None:
        return splats
    return quantise_for_sog(splats, BitDepths(**quantised.sog_bits))


def _positions(means: NDArray[np.floating], bits: int) -> NDArray[np.float32]:
    if bits >= 16:
        return means.astype(np.float32)
    low, high = position_range(means)
    span = np.where(high > low, high - low, 1.0)
    steps = _coarse((symmetric_log(means) - low) / span, STEPS, 16 - bits)
    return symmetric_exp(low + span * steps / STEPS).astype(np.float32)


def _rotations(quaternions: NDArray[np.floating], bits: int) -> NDArray[np.float32]:
    largest, others = smallest_three.split(unit_quaternions(quaternions))
    steps = _coarse(smallest_three.fractions_of(others), 255, 8 - bits)
    return smallest_three.join(largest, smallest_three.from_fractions(steps / 255))


def _by_codebook(values: NDArray[np.floating], bits: int) -> NDArray[np.float32]:
    book = codebook.scalar_codebook(values, 1 << bits)
    return np.asarray(book[codebook.nearest(book, values)].astype(np.float32))


def _by_palette(rest: NDArray[np.floating], bits: int) -> NDArray[np.float32]:
    palette, labels = palette_of(rest.astype(np.float32), bits)
    return palette[labels].reshape(rest.shape)


def _opacities(splats: Splats, bits: int) -> NDArray[np.float32]:
    steps = _coarse(linear_opacities(splats).astype(np.float64), 255, 8 - bits)
    return logits_of(np.maximum(steps, 1) / 255)


def _coarse(fractions: NDArray[np.floating], top: int, dropped: int) -> NDArray[np.floating]:
    """The nearest of 0..top, without the lowest `dropped` bits; `top` itself stays."""
    coarse = 1 << dropped
    return np.asarray(np.minimum(np.rint(top * fractions / coarse) * coarse, top))
