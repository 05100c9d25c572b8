"""One thing to be damaged, and the reader that meets it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stages import formats

SPLATS = 40
MOST_SPLATS = 1 << 16  # more cannot come out of a file of some 10 kB


def read_splats(path: Path) -> int:
    """How many a file holds. Raises SplatError if it is refused, AssertionError if what comes out
    cannot be."""
    splats = formats.read(path)
    assert len(splats) <= MOST_SPLATS
    for values in ("means", "quaternions", "log_scales", "opacity_logits", "sh"):
        assert np.isfinite(getattr(splats, values)).all(), values
    return len(splats)


@dataclass(frozen=True)
class Layer:
    """name: of the file. content: of the whole file, or of what is inside it. pack: makes the file
    again. beside: other files of the same folder, by name. text: whether words can be changed.
    share: of the inputs that others get, where each takes a process. read: how many things came
    out, which is `holds` where nothing is damaged."""

    name: str
    content: Callable[[], bytes]
    pack: Callable[[bytes], bytes] = bytes
    beside: Callable[[], dict[str, bytes]] = dict
    text: bool = False
    share: float = 1.0
    read: Callable[[Path], int] = read_splats
    holds: int = SPLATS
