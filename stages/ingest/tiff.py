"""Finds the TIFF files that the libraries decode to another picture without an error, by their tags
(TIFF 6.0)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

_BITS, _COMPRESSION, _PHOTOMETRIC, _PLANAR, _PREDICTOR, _SAMPLES = 258, 259, 262, 284, 317, 339
_UNCOMPRESSED, _SEPARATE, _MIN_IS_WHITE, _UNSIGNED = 1, 2, 0, 1
_PREDICTED = (5, 8, 32946, 34925, 50000)  # LZW, Deflate (two numbers), LZMA, Zstandard
_INTEGERS = {1, 2, 4, 8, 16}


def is_negative(tags: Mapping[int, Any]) -> bool:
    """Whether 0 stands for white."""
    return bool(tags.get(_PHOTOMETRIC) == _MIN_IS_WHITE)


def tiff_fault(tags: Mapping[int, Any]) -> str:
    """Why a file of these `tags`, by number, would become another picture; "" if it would not."""
    bits, kinds = set(tags.get(_BITS, (1,))), set(tags.get(_SAMPLES, (_UNSIGNED,)))
    compression = tags.get(_COMPRESSION, _UNCOMPRESSED)
    if kinds == {_UNSIGNED} and not bits <= _INTEGERS:
        return f"its samples have {max(bits)} bits"
    if kinds & {2, 5}:
        return "its samples are signed numbers"
    separate = tags.get(_PLANAR) == _SEPARATE and compression == _UNCOMPRESSED
    if separate and bits == {16}:
        return "its channels of 16 bits are stored one after the other, without compression"
    if tags.get(_PREDICTOR, 1) != 1 and compression not in _PREDICTED:
        return "it declares a predictor, which its compression does not have"
    return ""
