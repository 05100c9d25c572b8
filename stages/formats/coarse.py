"""Splats whose values are told in fewer bits, for formats that pack what repeats.

A format's writer stays as it is: values that lie on a coarser grid of its own take fewer bytes once
they are compressed, and every reader reads them as it always did.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from stages.base.lazy import named
from stages.formats import codebook, smallest_three
from stages.formats.rows import kept_rows, linear_opacities, logits_of, unit_quaternions
from stages.formats.sog import LOG_SCALE_LIMIT, STEPS, bent, unbent
from stages.formats.table import Format
from stages.scene import QuantisedSplats, Splats


@dataclass(frozen=True)
class Bits:
    """How many each value is told in."""

    position: int = 16
    rotation: int = 8
    scale: int = 8
    colour: int = 8
    opacity: int = 8


def of_sog(splats: Splats, bits: Bits) -> Splats:
    """What a .sog holds of them in so many bits, on the grids that its writer will find again."""
    if not len(splats):
        return splats
    logs = np.clip(splats.log_scales, -LOG_SCALE_LIMIT, LOG_SCALE_LIMIT)
    sh = splats.sh.copy()
    sh[:, 0] = _by_codebook(sh[:, 0], bits.colour)
    return replace(
        splats,
        means=_positions(splats.means, bits.position),
        quaternions=_rotations(splats.quaternions, bits.rotation),
        log_scales=_by_codebook(logs, bits.scale),
        opacity_logits=_opacities(splats, bits.opacity),
        sh=sh,
    )


def held_by(row: Format, quantised: QuantisedSplats) -> Splats:
    """What a file of this format should hold: drawable splats, their mean colours where colours do
    not change with the view, in as many bits as were decided on."""
    splats = quantised.splats
    if not row.sh_degree and quantised.flat_dc is not None:
        sh = quantised.flat_dc[:, None].astype(splats.sh.dtype)
        splats = replace(splats.with_sh_degree(0), sh=sh)
    splats = kept_rows(splats)[0]
    bits = quantised.decisions.get("bits")
    if not row.coarse or not isinstance(bits, dict):
        return splats
    found: Splats = named(row.coarse)(splats, Bits(**bits))
    return found


def _positions(means: NDArray[np.floating], bits: int) -> NDArray[np.float32]:
    if bits >= 16:
        return means.astype(np.float32)
    curved = bent(means)
    low, high = curved.min(axis=0), curved.max(axis=0)
    span = np.where(high > low, high - low, 1.0)
    coarse = 1 << (16 - bits)
    steps = np.minimum(np.rint((curved - low) / span * (STEPS / coarse)) * coarse, STEPS)
    found: NDArray[np.float32] = unbent(low + span * steps / STEPS).astype(np.float32)
    return found


def _rotations(quaternions: NDArray[np.floating], bits: int) -> NDArray[np.float32]:
    coarse, limit = 1 << (8 - bits), smallest_three.LIMIT
    largest, others = smallest_three.split(unit_quaternions(quaternions))
    steps = np.minimum(np.rint(255 * (0.5 + others / (2 * limit)) / coarse) * coarse, 255)
    return smallest_three.join(largest, (steps / 255 - 0.5) * 2 * limit)


def _by_codebook(values: NDArray[np.floating], bits: int) -> NDArray[np.float32]:
    book = codebook.of_numbers(values, 1 << bits)
    found: NDArray[np.float32] = book[codebook.nearest(book, values)].astype(np.float32)
    return found


def _opacities(splats: Splats, bits: int) -> NDArray[np.float32]:
    coarse = 1 << (8 - bits)
    steps = np.rint(255 * linear_opacities(splats).astype(np.float64) / coarse) * coarse
    return logits_of(np.clip(steps, 1, 255) / 255)
