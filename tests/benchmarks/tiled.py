"""A large scene made of a trained one, set beside itself, no two splats of the same colour:
`python -m tests.benchmarks.tiled FILE SPLATS OUT.ply [DEGREE]`, in the memory of one tile."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from stages import formats
from stages.formats import ply
from stages.formats.ply_header import header_text
from stages.scene import Splats, load_splats

_UNLIKE = 0.02  # standard deviation of what each coefficient differs by from one tile to the next


def main(source: Path, count: int, target: Path, degree: int | None = None) -> None:
    """degree: of view-dependent colour; that of the source where None."""
    tile = load_splats(source) if source.suffix == ".bin" else formats.read(source)
    tile = tile if degree is None else tile.with_sh_degree(degree)
    low, high = np.quantile(tile.means, (0.02, 0.98), axis=0)
    wide = int(np.ceil(np.sqrt(count / len(tile))))
    columns = [f"property float {name}" for name in ply.property_names(tile.sh_degree)]
    with target.open("wb") as file:
        elements = [f"element vertex {count}", *columns]
        file.write(header_text("arbitrary", np.zeros(3), None, elements))
        for number, start in enumerate(range(0, count, len(tile))):
            place = (high - low) * (number % wide, 0, number // wide)
            part = _unlike(tile, place, number).take(slice(0, count - start))
            body = b"".join(ply.file_blocks(part, "arbitrary"))
            file.write(body[body.index(b"end_header\n") + len(b"end_header\n") :])


def _unlike(tile: Splats, place: np.ndarray, number: int) -> Splats:
    """The tile at `place`, so that no palette is shared: real scenes do not repeat."""
    noise = np.random.default_rng(number).normal(0, _UNLIKE, tile.sh.shape)
    means, sh = tile.means + place, tile.sh + noise
    return replace(tile, means=means.astype(np.float32), sh=sh.astype(np.float32))


if __name__ == "__main__":
    where, how_many, out, *of_degree = sys.argv[1:]
    main(Path(where), int(how_many), Path(out), *map(int, of_degree))
