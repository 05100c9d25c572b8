"""Chooses the bit depth of each attribute of a .sog file by the PSNR (dB) that each bit costs and
the bytes that it saves, and predicts file sizes (bytes)."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

from stages import formats
from stages.formats.axes import smallest_rotations
from stages.formats.format_table import Format
from stages.formats.sog_quantisation import (
    BitDepths,
    palette_bits,
    quantise_attribute,
    quantise_for_sog,
    quantise_splats,
)
from stages.formats.values import drop_undrawable
from stages.scene import Splats, View

# Of each attribute of a .sog: (values per splat, smallest bit depth).
_ATTRIBUTES = {
    "position": (3, 10),
    "rotation": (3, 4),
    "scale": (3, 4),
    "colour": (3, 4),
    "opacity": (1, 3),
    "palette": (0, 5),
}
_ENTROPY = 0.9  # share of a palette's bits that compression leaves, about
_NOISE_DB = 1e-4  # a loss below it is chance


def choose_bits(
    splats: Splats, psnr_db: Callable[[Splats], float], loss_db: float
) -> tuple[dict[str, int], float]:
    """(bit depth by attribute of a .sog file; PSNR of such a file).

    Greedy: one bit is removed at a time, where it saves most bytes per dB lost, while the total
    loss is at most `loss_db`. The next bit of the same attribute is predicted to cost four times
    as much, because the quantisation step doubles.

    Args:
        splats: to be written.
        psnr_db: measures the mean PSNR of splats on training views.
        loss_db: what all removed bits together may cost.
    """
    exact = smallest_rotations(drop_undrawable(splats)[0])
    depths = asdict(BitDepths(palette=palette_bits(len(exact))))
    if not len(exact):
        return depths, 0.0
    splats = quantise_splats(exact, BitDepths(**depths))
    current_db = psnr_db(splats)
    floor_db = current_db - loss_db
    least = {name: bits for name, (_, bits) in _ATTRIBUTES.items()}
    if not splats.sh_degree:
        least["palette"] = depths["palette"]
    losses = {
        name: current_db - psnr_db(quantise_attribute(exact, splats, name, bits - 1))
        for name, bits in depths.items()
        if bits > least[name]
    }
    while losses:
        name = max(losses, key=lambda n: _saved(n, depths[n], exact) / max(losses[n], _NOISE_DB))
        candidate = quantise_attribute(exact, splats, name, depths[name] - 1)
        candidate_db = psnr_db(candidate)
        if candidate_db < floor_db:
            del losses[name]
            continue
        losses[name] = 4 * max(current_db - candidate_db, _NOISE_DB)
        splats, current_db = candidate, candidate_db
        depths[name] -= 1
        if depths[name] == least[name]:
            del losses[name]
    return depths, current_db


def _saved(name: str, bits: int, splats: Splats) -> float:
    """Bytes that one bit less of an attribute saves, about: for a palette, half of its entries and
    one bit of each label."""
    if name != "palette":
        return _ATTRIBUTES[name][0] * len(splats) / 8
    labelled = int((splats.sh_degrees > 0).sum())
    values = 3 * (splats.sh.shape[1] - 1)
    return float((1 << (bits - 1)) * values * _ENTROPY + labelled / 8)


def file_size_bytes(
    row: Format, splats: Splats, depths: dict[str, int], units: str, views: tuple[View, ...]
) -> int:
    """The size of `splats` as a file of the format, found by writing it. depths: see `choose_bits`;
    empty for formats without."""
    held = quantise_for_sog(splats, BitDepths(**depths)) if depths else splats
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / row.file_name("scene")
        formats.write(path, held, units=units, views=views)
        return row.size_bytes(path)
