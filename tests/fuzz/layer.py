"""One thing to be damaged, and the reader that meets it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stages import formats
from stages.scene import Splats

SPLATS = 40
MOST_SPLATS = 1 << 16  # more cannot come out of a file of some 10 kB


def read_splats(path: Path) -> int:
    """How many a file holds. Raises SplatError if it is refused, AssertionError if what comes out
    cannot be."""
    return checked(formats.read(path))


def checked(splats: Splats) -> int:
    """How many there are. Raises AssertionError for values that no reader may return."""
    assert len(splats) <= MOST_SPLATS
    for values in ("means", "quaternions", "log_scales", "opacity_logits", "sh"):
        assert np.isfinite(getattr(splats, values)).all(), values
    return len(splats)


@dataclass(frozen=True)
class Layer:
    """name: of the file. content: of the whole file, or of what is inside it. pack: makes the file
    again. beside: other files of the same folder, by name. text: whether words can be changed.
    read: how many things came out, which is `holds` where nothing is damaged; it raises
    SplatError or Unusable. in_fork: whether the reader reads in a process of its own, which may
    die; `read` then returns its exit status."""

    name: str
    content: Callable[[], bytes]
    pack: Callable[[bytes], bytes] = bytes
    beside: Callable[[], dict[str, bytes]] = dict
    text: bool = False
    read: Callable[[Path], int] = read_splats
    holds: int = SPLATS
    in_fork: bool = False
