"""Spherical harmonics and their gradients, eight directions at a time."""

from __future__ import annotations

from stages.raster.kernels.simd import kernel
from stages.raster.kernels.simd64 import at, put
from stages.raster.sh import C0, C1, C2, C3


@kernel
def sh_basis(degree, x, y, z, basis):
    """Basis function k of eight unit directions into basis[8 k : 8 k + 8], to `degree`."""
    put(basis, 0, 0.0 * x + C0)
    if degree < 1:
        return
    put(basis, 1, -C1 * y)
    put(basis, 2, C1 * z)
    put(basis, 3, -C1 * x)
    if degree < 2:
        return
    xx, yy, zz = x * x, y * y, z * z
    put(basis, 4, C2[0] * x * y)
    put(basis, 5, -C2[0] * y * z)
    put(basis, 6, C2[1] * (2.0 * zz - xx - yy))
    put(basis, 7, -C2[0] * x * z)
    put(basis, 8, C2[2] * (xx - yy))
    if degree < 3:
        return
    put(basis, 9, -C3[0] * y * (3.0 * xx - yy))
    put(basis, 10, C3[1] * x * y * z)
    put(basis, 11, -C3[2] * y * (4.0 * zz - xx - yy))
    put(basis, 12, C3[3] * z * (2.0 * zz - 3.0 * xx - 3.0 * yy))
    put(basis, 13, -C3[2] * x * (4.0 * zz - xx - yy))
    put(basis, 14, C3[4] * z * (xx - yy))
    put(basis, 15, -C3[0] * x * (xx - 3.0 * yy))


@kernel
def sh_direction_gradient(degree, x, y, z, w):
    """Gradient of sum(w * basis) with respect to the direction, before its normalisation.

    w: as `basis` in `sh_basis`; the gradient that reaches each basis value. Degree 1 at least.
    """
    gx = -C1 * at(w, 3)
    gy = -C1 * at(w, 1)
    gz = C1 * at(w, 2)
    if degree < 2:
        return gx, gy, gz
    w6, w8 = 2.0 * C2[1] * at(w, 6), 2.0 * C2[2] * at(w, 8)
    gx = gx + C2[0] * (y * at(w, 4) - z * at(w, 7)) - x * w6 + x * w8
    gy = gy + C2[0] * (x * at(w, 4) - z * at(w, 5)) - y * w6 - y * w8
    gz = gz + (-C2[0] * (y * at(w, 5) + x * at(w, 7)) + 4.0 * C2[1] * z * at(w, 6))
    if degree < 3:
        return gx, gy, gz
    xx, yy, zz = x * x, y * y, z * z
    gx = gx + (
        -6.0 * C3[0] * x * y * at(w, 9)
        + C3[1] * y * z * at(w, 10)
        + 2.0 * C3[2] * x * y * at(w, 11)
        - 6.0 * C3[3] * x * z * at(w, 12)
        - C3[2] * (4.0 * zz - 3.0 * xx - yy) * at(w, 13)
        + 2.0 * C3[4] * x * z * at(w, 14)
        - 3.0 * C3[0] * (xx - yy) * at(w, 15)
    )
    gy = gy + (
        -3.0 * C3[0] * (xx - yy) * at(w, 9)
        + C3[1] * x * z * at(w, 10)
        - C3[2] * (4.0 * zz - xx - 3.0 * yy) * at(w, 11)
        - 6.0 * C3[3] * y * z * at(w, 12)
        + 2.0 * C3[2] * x * y * at(w, 13)
        - 2.0 * C3[4] * y * z * at(w, 14)
        + 6.0 * C3[0] * x * y * at(w, 15)
    )
    gz = gz + (
        C3[1] * x * y * at(w, 10)
        - 8.0 * C3[2] * y * z * at(w, 11)
        + 3.0 * C3[3] * (2.0 * zz - xx - yy) * at(w, 12)
        - 8.0 * C3[2] * x * z * at(w, 13)
        + C3[4] * (xx - yy) * at(w, 14)
    )
    return gx, gy, gz
