"""Spherical harmonics and their gradients, eight directions at a time."""

from __future__ import annotations

from stages.kernels.simd import kernel
from stages.kernels.simd64 import LANES, dload, dstore
from stages.raster.sh import C0, C1, C2, C3


@kernel
def sh_basis(degree, x, y, z, basis):
    """Basis function k of eight unit directions into basis[8 k : 8 k + 8], to `degree`."""
    dstore(basis, 0, 0.0 * x + C0)
    if degree < 1:
        return
    dstore(basis, 1 * LANES, -C1 * y)
    dstore(basis, 2 * LANES, C1 * z)
    dstore(basis, 3 * LANES, -C1 * x)
    if degree < 2:
        return
    xx, yy, zz = x * x, y * y, z * z
    dstore(basis, 4 * LANES, C2[0] * x * y)
    dstore(basis, 5 * LANES, -C2[0] * y * z)
    dstore(basis, 6 * LANES, C2[1] * (2.0 * zz - xx - yy))
    dstore(basis, 7 * LANES, -C2[0] * x * z)
    dstore(basis, 8 * LANES, C2[2] * (xx - yy))
    if degree < 3:
        return
    dstore(basis, 9 * LANES, -C3[0] * y * (3.0 * xx - yy))
    dstore(basis, 10 * LANES, C3[1] * x * y * z)
    dstore(basis, 11 * LANES, -C3[2] * y * (4.0 * zz - xx - yy))
    dstore(basis, 12 * LANES, C3[3] * z * (2.0 * zz - 3.0 * xx - 3.0 * yy))
    dstore(basis, 13 * LANES, -C3[2] * x * (4.0 * zz - xx - yy))
    dstore(basis, 14 * LANES, C3[4] * z * (xx - yy))
    dstore(basis, 15 * LANES, -C3[0] * x * (xx - 3.0 * yy))


@kernel
def _w(w, k):
    return dload(w, LANES * k)


@kernel
def sh_direction_gradient(degree, x, y, z, w):
    """Gradient of sum(w * basis) with respect to the direction, before its normalisation.

    w: as `basis` in `sh_basis`; the gradient that reaches each basis value. Degree 1 at least.
    """
    gx = -C1 * _w(w, 3)
    gy = -C1 * _w(w, 1)
    gz = C1 * _w(w, 2)
    if degree < 2:
        return gx, gy, gz
    w6, w8 = 2.0 * C2[1] * _w(w, 6), 2.0 * C2[2] * _w(w, 8)
    gx = gx + C2[0] * (y * _w(w, 4) - z * _w(w, 7)) - x * w6 + x * w8
    gy = gy + C2[0] * (x * _w(w, 4) - z * _w(w, 5)) - y * w6 - y * w8
    gz = gz + (-C2[0] * (y * _w(w, 5) + x * _w(w, 7)) + 4.0 * C2[1] * z * _w(w, 6))
    if degree < 3:
        return gx, gy, gz
    xx, yy, zz = x * x, y * y, z * z
    gx = gx + (
        -6.0 * C3[0] * x * y * _w(w, 9)
        + C3[1] * y * z * _w(w, 10)
        + 2.0 * C3[2] * x * y * _w(w, 11)
        - 6.0 * C3[3] * x * z * _w(w, 12)
        - C3[2] * (4.0 * zz - 3.0 * xx - yy) * _w(w, 13)
        + 2.0 * C3[4] * x * z * _w(w, 14)
        - 3.0 * C3[0] * (xx - yy) * _w(w, 15)
    )
    gy = gy + (
        -3.0 * C3[0] * (xx - yy) * _w(w, 9)
        + C3[1] * x * z * _w(w, 10)
        - C3[2] * (4.0 * zz - xx - 3.0 * yy) * _w(w, 11)
        - 6.0 * C3[3] * y * z * _w(w, 12)
        + 2.0 * C3[2] * x * y * _w(w, 13)
        - 2.0 * C3[4] * y * z * _w(w, 14)
        + 6.0 * C3[0] * x * y * _w(w, 15)
    )
    gz = gz + (
        C3[1] * x * y * _w(w, 10)
        - 8.0 * C3[2] * y * z * _w(w, 11)
        + 3.0 * C3[3] * (2.0 * zz - xx - yy) * _w(w, 12)
        - 8.0 * C3[2] * x * z * _w(w, 13)
        + C3[4] * (xx - yy) * _w(w, 14)
    )
    return gx, gy, gz
