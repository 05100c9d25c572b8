"""In how few bits a file may tell its values, decided by drawing."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict

from stages.formats.axes import smallest_rotations
from stages.formats.quantisation import BitDepths, palette_bits, quantise_attribute, quantise_splats
from stages.formats.values import drop_undrawable
from stages.scene import Splats

# Of what a .sog tells its values in: (numbers of a splat, the fewest bits).
_NUMBERS = {
    "position": (3, 10),
    "rotation": (3, 4),
    "scale": (3, 4),
    "colour": (3, 4),
    "opacity": (1, 3),
    "palette": (0, 5),
}
_ENTROPY = 0.9  # of the bits of a palette's numbers: about what compression leaves
_LEAST_DB = 1e-4  # a loss below it is chance


def choose_bits(
    splats: Splats, psnr_db: Callable[[Splats], float], loss_db: float
) -> tuple[dict[str, int], float]:
    """(by attribute, in how many bits a .sog tells it; PSNR of such a file). The next bit goes
    where it saves most bytes for what it costs, as long as all together cost `psnr_db` no more
    than loss_db. A step that follows is foretold to cost four times as much: half the precision."""
    exact = smallest_rotations(drop_undrawable(splats)[0])
    found = asdict(BitDepths(palette=palette_bits(len(exact))))
    if not len(exact):
        return found, 0.0
    splats = quantise_splats(exact, BitDepths(**found))
    best = psnr_db(splats)
    floor, least = best - loss_db, {n: bits for n, (_, bits) in _NUMBERS.items()}
    if not splats.sh_degree:
        least["palette"] = found["palette"]
    losses = {
        name: best - psnr_db(quantise_attribute(exact, splats, name, bits - 1))
        for name, bits in found.items()
        if bits > least[name]
    }
    while losses:
        name = max(losses, key=lambda n: _saved(n, found[n], exact) / max(losses[n], _LEAST_DB))
        tried = quantise_attribute(exact, splats, name, found[name] - 1)
        found_db = psnr_db(tried)
        if found_db < floor:
            del losses[name]
            continue
        losses[name] = 4 * max(best - found_db, _LEAST_DB)
        splats, best = tried, found_db
        found[name] -= 1
        if found[name] == least[name]:
            del losses[name]
    return found, best


def _saved(name: str, bits: int, splats: Splats) -> float:
    """Bytes that one bit less of an attribute is worth, about: each number's, or half a palette and
    a bit of each label."""
    if name != "palette":
        return _NUMBERS[name][0] * len(splats) / 8
    labelled = int((splats.sh_degrees > 0).sum())
    numbers = 3 * (splats.sh.shape[1] - 1)
    found: float = (1 << (bits - 1)) * numbers * _ENTROPY + labelled / 8
    return found
