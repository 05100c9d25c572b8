"""Values inside the CPU's kernels, one row at a time."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stages.raster.cpu.projection import WORK_ROW, footprint
from stages.raster.cpu.sh_kernels import sh_basis
from stages.raster.cpu.splat_kernels import name_rows
from stages.raster.kernels.simd import kernel
from stages.raster.kernels.simd64 import LANES, at, bits8, gather8, scatter8


@kernel
def _fill(rows, cam, means, quaternions, log_scales, opacity_logits, smoothing, w):
    return bits8(footprint(rows, cam, means, quaternions, log_scales, opacity_logits, smoothing, w))


def footprint_values(
    row: int, cam: NDArray[np.float64], arrays: tuple[NDArray[np.float32], ...]
) -> NDArray[np.float64]:
    """[WORK_ROW] the result of `footprint` for one row."""
    work = np.zeros(WORK_ROW * LANES)
    rows = np.full(LANES, row, np.int64)
    _fill(rows, cam, *arrays[:4], np.zeros(0, np.float32), work)
    return work.reshape(WORK_ROW, LANES)[:, 0].copy()


@kernel
def sh_basis_values(degree, directions):
    """[N, (degree + 1)^2] basis functions of unit directions [N, 3]."""
    n, coefficients = len(directions), (degree + 1) * (degree + 1)
    out = np.empty((n, coefficients), np.float64)
    basis = np.empty(16 * LANES, np.float64)
    rows = np.empty(LANES, np.int64)
    for start in range(0, n, LANES):
        name_rows(rows, start, n)
        x, y = gather8(directions, rows, 3, 0), gather8(directions, rows, 3, 1)
        sh_basis(degree, x, y, gather8(directions, rows, 3, 2), basis)
        for coefficient in range(coefficients):
            scatter8(out, rows, coefficients, coefficient, at(basis, coefficient))
    return out
