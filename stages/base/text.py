"""Text that depends on a number."""

from __future__ import annotations


def counted(count: int, noun: str, plural: str = "") -> str:
    """ "1 photograph", "3 photographs", "1,200 splats". plural: where adding an s is wrong."""
    return f"{count:,} {noun if count == 1 else plural or noun + 's'}"
