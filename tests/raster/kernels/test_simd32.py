"""Vectors of 8 int32 lanes, against plain Python."""

from __future__ import annotations

import numba
import numpy as np
import pytest

from stages.raster.kernels.simd32 import LANES, least8, most8, span_bits

FAR = 10**9


@numba.njit
def found(spans, at, base):
    return least8(spans, at), most8(spans, at + 8), span_bits(spans, at, base)


def plain_bits(spans: np.ndarray, at: int, base: int) -> int:
    bits = 0
    for q in range(LANES):
        for column in range(4):
            inside = spans[at + q] <= base + column <= spans[at + 8 + q]
            bits |= int(inside) << (4 * q + column)
    return bits


@pytest.mark.parametrize("seed", range(20))
def test_ends_and_bits_of_spans_are_those_of_their_columns(seed: int) -> None:
    r = np.random.default_rng(seed)
    spans = r.integers(-3, 12, 48).astype(np.int32)  # some end before they begin
    spans[20:24], spans[28:32] = FAR, -1  # rows without a column
    for at in (0, 16, 32):
        for base in (0, 4, 8, 12):
            least, most, bits = found(spans, at, base)
            assert least == spans[at : at + 8].min()
            assert most == spans[at + 8 : at + 16].max()
            assert bits == plain_bits(spans, at, base)


def test_rows_without_a_column_have_no_bits_however_far_their_span_begins() -> None:
    spans = np.repeat(np.array([FAR, -1], np.int32), 8)
    least, most, bits = found(spans, 0, FAR)
    assert (least, most, bits) == (FAR, -1, 0)
