"""Rotation by 180 degrees about x, between our y-down world and y-up formats.

(x, y, z) becomes (x, -y, -z). The rotation is its own inverse and exact: values change their sign
only.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from stages.scene import Splats
from stages.scene.place import EarthPlace

FLIP = np.array([1.0, -1.0, -1.0])

# Each real spherical harmonic is a polynomial in the direction; its sign under y -> -y, z -> -z,
# in the order m = -l..l (Kerbl et al. 2023, and KHR_gaussian_splatting appendix A):
# 1 | y z x | xy yz 2zz-xx-yy xz xx-yy |
# y(3xx-yy) xyz y(4zz-xx-yy) z(2zz-3xx-3yy) x(4zz-xx-yy) z(xx-yy) x(xx-3yy)
SH_SIGNS = np.array([1, -1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1], np.float32)

# Rotating by q and then by the half turn h gives h q. We store h q h* instead: the factor h*
# rotates the ellipsoid by 180 degrees about one of its own axes, which changes nothing, and so an
# unrotated splat stays unrotated.
_QUATERNION_SIGNS = np.array([1, 1, -1, -1], np.float32)


def flipped(splats: Splats, *, reuse: bool = False) -> Splats:
    """The splats in the other frame (y down to y up, and back).

    reuse: write into the arrays of `splats`, which the caller no longer needs.
    """
    signs = {
        "means": FLIP.astype(splats.means.dtype),
        "quaternions": _QUATERNION_SIGNS,
        "sh": SH_SIGNS[: splats.sh.shape[1], None],
    }
    arrays = {}
    for name, sign in signs.items():
        values = getattr(splats, name)
        with np.errstate(
            invalid="ignore"
        ):  # a damaged file's NaN; `values.check_finite` refuses it
            arrays[name] = np.multiply(values, sign, out=values if reuse else None)
    # + 0.0: an origin of -0 would be written as such
    origin, place = splats.origin * FLIP + 0.0, flipped_place(splats.place)
    camera = splats.first_camera and splats.first_camera.moved(np.diag([*FLIP, 1.0]))
    return replace(splats, **arrays, origin=origin, place=place, first_camera=camera)


def flipped_place(place: EarthPlace | None) -> EarthPlace | None:
    """The place of the other frame."""
    return place and place.moved(np.diag([*FLIP, 1.0]))
