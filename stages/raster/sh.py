"""Real spherical harmonics to degree 3, as tables of numbers for every backend.

Order and signs are the reference trainer's (Kerbl et al. 2023): degree by degree, m = -l..l, with
the Condon-Shortley sign, for a unit direction (x, y, z) from the camera to the splat.
"""

from __future__ import annotations

from stages.raster.simd import kernel

C0 = 0.28209479177387814  # sqrt(1 / (4 pi))
C1 = 0.4886025119029199  # sqrt(3 / (4 pi))
C2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
C3 = (
    0.5900435899266435,
    2.890611442640554,
    0.4570457994644658,
    0.3731763325901154,
    1.445305721320277,
)


@kernel
def sh_basis(degree, x, y, z, basis):
    """Fill basis[: (degree + 1)^2] for the unit direction (x, y, z)."""
    basis[0] = C0
    if degree < 1:
        return
    basis[1] = -C1 * y
    basis[2] = C1 * z
    basis[3] = -C1 * x
    if degree < 2:
        return
    xx, yy, zz = x * x, y * y, z * z
    basis[4] = C2[0] * x * y
    basis[5] = -C2[0] * y * z
    basis[6] = C2[1] * (2.0 * zz - xx - yy)
    basis[7] = -C2[0] * x * z
    basis[8] = C2[2] * (xx - yy)
    if degree < 3:
        return
    basis[9] = -C3[0] * y * (3.0 * xx - yy)
    basis[10] = C3[1] * x * y * z
    basis[11] = -C3[2] * y * (4.0 * zz - xx - yy)
    basis[12] = C3[3] * z * (2.0 * zz - 3.0 * xx - 3.0 * yy)
    basis[13] = -C3[2] * x * (4.0 * zz - xx - yy)
    basis[14] = C3[4] * z * (xx - yy)
    basis[15] = -C3[0] * x * (xx - 3.0 * yy)


@kernel
def sh_direction_gradient(degree, x, y, z, w):
    """Gradient of sum(w * basis) with respect to the direction, before its normalisation.

    w[(degree + 1)^2]: the gradient that reaches each basis value.
    """
    gx = -C1 * w[3]
    gy = -C1 * w[1]
    gz = C1 * w[2]
    if degree < 2:
        return gx, gy, gz
    gx += C2[0] * (y * w[4] - z * w[7]) - 2.0 * C2[1] * x * w[6] + 2.0 * C2[2] * x * w[8]
    gy += C2[0] * (x * w[4] - z * w[5]) - 2.0 * C2[1] * y * w[6] - 2.0 * C2[2] * y * w[8]
    gz += -C2[0] * (y * w[5] + x * w[7]) + 4.0 * C2[1] * z * w[6]
    if degree < 3:
        return gx, gy, gz
    xx, yy, zz = x * x, y * y, z * z
    gx += (
        -6.0 * C3[0] * x * y * w[9]
        + C3[1] * y * z * w[10]
        + 2.0 * C3[2] * x * y * w[11]
        - 6.0 * C3[3] * x * z * w[12]
        - C3[2] * (4.0 * zz - 3.0 * xx - yy) * w[13]
        + 2.0 * C3[4] * x * z * w[14]
        - 3.0 * C3[0] * (xx - yy) * w[15]
    )
    gy += (
        -3.0 * C3[0] * (xx - yy) * w[9]
        + C3[1] * x * z * w[10]
        - C3[2] * (4.0 * zz - xx - 3.0 * yy) * w[11]
        - 6.0 * C3[3] * y * z * w[12]
        + 2.0 * C3[2] * x * y * w[13]
        - 2.0 * C3[4] * y * z * w[14]
        + 6.0 * C3[0] * x * y * w[15]
    )
    gz += (
        C3[1] * x * y * w[10]
        - 8.0 * C3[2] * y * z * w[11]
        + 3.0 * C3[3] * (2.0 * zz - xx - yy) * w[12]
        - 8.0 * C3[2] * x * z * w[13]
        + C3[4] * (xx - yy) * w[14]
    )
    return gx, gy, gz
