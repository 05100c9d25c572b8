"""A large scene made of a trained one, set beside itself, with view-dependent colour of degree 3:
`python -m tests.benchmarks.tiled FILE.ply SPLATS OUT.ply`."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from stages import formats
from stages.formats import ply
from stages.formats.ply_header import header_text


def main(source: Path, count: int, target: Path) -> None:
    tile = formats.read(source).with_sh_degree(3)
    tile.sh[:, 1:] = np.random.default_rng(0).normal(0, 0.05, tile.sh[:, 1:].shape)
    low, high = np.quantile(tile.means, (0.02, 0.98), axis=0)
    wide = int(np.ceil(np.sqrt(count / len(tile))))
    columns = [f"property float {name}" for name in ply.property_names(3)]
    with target.open("wb") as file:
        file.write(header_text("arbitrary", np.zeros(3), [f"element vertex {count}", *columns]))
        for number, start in enumerate(range(0, count, len(tile))):
            place = (high - low) * (number % wide, 0, number // wide)
            moved = replace(tile, means=(tile.means + place).astype(np.float32))
            part = moved.take(slice(0, count - start))
            body = b"".join(ply.blocks(part, "arbitrary"))
            file.write(body[body.index(b"end_header\n") + len(b"end_header\n") :])


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]), Path(sys.argv[3]))
