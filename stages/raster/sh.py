"""Real spherical harmonics to degree 3, as tables of numbers for every backend, and which of them
a splat has.

Order and signs are the reference trainer's (Kerbl et al. 2023): degree by degree, m = -l..l, with
the Condon-Shortley sign, for a unit direction (x, y, z) from the camera to the splat.
"""

from __future__ import annotations

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


def own_coefficients(sh_degrees: NDArray[np.integer], count: int) -> NDArray[np.bool_]:
    """[N, count, 1] which of the first `count` SH coefficients a splat of each degree [N] has."""
    own = (sh_degrees.astype(np.int64) + 1) ** 2
    return np.asarray(np.arange(count)[:, None] < own[:, None, None])
