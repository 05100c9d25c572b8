"""Real spherical harmonics to degree 3, as tables of numbers for every backend.

Order and signs are the reference trainer's (Kerbl et al. 2023): degree by degree, m = -l..l, with
the Condon-Shortley sign, for a unit direction (x, y, z) from the camera to the splat.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

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


def basis_columns(x: Any, y: Any, z: Any, degree: int) -> list[Any]:
    """The (degree + 1)^2 - 1 basis functions after the constant one, of unit directions x, y, z:
    arrays of NumPy or torch."""
    xx, yy, zz = x * x, y * y, z * z
    columns = [-C1 * y, C1 * z, -C1 * x]
    columns += [C2[0] * x * y, -C2[0] * y * z, C2[1] * (2 * zz - xx - yy)]
    columns += [-C2[0] * x * z, C2[2] * (xx - yy)]
    columns += [-C3[0] * y * (3 * xx - yy), C3[1] * x * y * z, -C3[2] * y * (4 * zz - xx - yy)]
    columns += [C3[3] * z * (2 * zz - 3 * xx - 3 * yy), -C3[2] * x * (4 * zz - xx - yy)]
    columns += [C3[4] * z * (xx - yy), -C3[0] * x * (xx - 3 * yy)]
    return columns[: (degree + 1) ** 2 - 1]


def sh_basis(directions: NDArray[np.floating], degree: int) -> NDArray[np.floating]:
    """[N, (degree + 1)^2] real spherical harmonics of unit directions [N, 3]."""
    x, y, z = directions.T
    return np.stack([np.full_like(x, C0), *basis_columns(x, y, z, degree)], -1)


def own_coefficients(sh_degrees: NDArray[np.integer], count: int) -> NDArray[np.bool_]:
    """[N, count, 1] which of the first `count` SH coefficients a splat of each degree [N] has."""
    own = (sh_degrees.astype(np.int64) + 1) ** 2
    return np.asarray(np.arange(count)[:, None] < own[:, None, None])
