"""Real spherical harmonics to degree 3, as tables of numbers for every backend.

Order and signs are the reference trainer's (Kerbl et al. 2023): degree by degree, m = -l..l, with
the Condon-Shortley sign, for a unit direction (x, y, z) from the camera to the splat.
"""

from __future__ import annotations

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
