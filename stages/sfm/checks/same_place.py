"""Were all photographs taken from one place, by turning or zooming? A look before the search.

Photographs from one place are related by homographies K2 R K1^-1 (Hartley and Zisserman 2004,
section 8.4): a rotation R and two focal lengths. A plane before a camera that moves gives a
homography, too, but not one of these. So a few photographs are compared at a small size. Structure
from motion would need minutes to find the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from stages.scene import Photo
from stages.scene.camera import fitted_size
from stages.sfm.checks.gates import MOVE, MOVE_ASIDE, no_parallax

LOOKED_AT = 7  # photographs, evenly spaced
SIDE_PX = 640
_FEATURES = 1000
_RATIO = 0.8  # of the distances to the nearest and the second nearest descriptor (Lowe 2004)
_FEWEST_MATCHES = 40
_FEWEST_PAIRS = 4
_MOST = 0.75  # of the pairs; of 19 captures with parallax none, at a turn or a zoom all
_ZOOMED = 1.15  # ratio of focal lengths
_AWAY_PX = 1.5  # of a match that fits
_SHARE = 0.9  # of the matches that fit an epipolar geometry
_FOCAL = 1.2  # x the longer side, where Exif states none
_FOCAL_RANGE = 2.0  # and a factor that it may be wrong by
_LEAST_MOTION = 0.05  # x the longer side: photographs that are nearly the same show nothing


def check_one_place(folder: Path, photos: Sequence[Photo]) -> None:
    """Raises SplatError "sfm-no-parallax" if the photographs were taken from one place."""
    how = same_place(folder, photos)
    if how:
        raise no_parallax(
            f"Between photographs the camera only {'turned' if how == 'turning' else 'zoomed'}: "
            "they",
            MOVE if how == "turning" else MOVE_ASIDE,
        )


def same_place(folder: Path, photos: Sequence[Photo]) -> str:
    """ "turning" or "zooming" if the photographs were taken from one place so, else "". folder: of
    the pictures. Some photographs are compared; four pairs at least must match."""
    chosen = [photos[i] for i in np.linspace(0, len(photos) - 1, LOOKED_AT).round().astype(int)]
    looked = [_features(folder / photo.image, photo) for photo in dict.fromkeys(chosen)]
    matched = (_matched(*pair) for pair in combinations(looked, 2))
    found = [_same_place(*pair) for pair in matched if pair is not None]
    zooms = [zoom for share, zoom in found if share >= _SHARE]
    if len(zooms) < max(_FEWEST_PAIRS, _MOST * len(found)):
        return ""
    return "zooming" if max(zooms) > _ZOOMED else "turning"


Features = tuple[NDArray[np.float64], NDArray[np.float32] | None, float]


def _features(path: Path, photo: Photo) -> Features:
    """(pixels from the middle [N, 2], descriptors, focal length); lengths over the longer side."""
    large = max(photo.width, photo.height) >= 2 * SIDE_PX
    how = cv2.IMREAD_REDUCED_GRAYSCALE_2 if large else cv2.IMREAD_GRAYSCALE
    grey = cv2.imdecode(np.fromfile(path, np.uint8), how)
    if grey is None:
        return np.zeros((0, 2)), None, _FOCAL
    grey = cv2.resize(grey, fitted_size(grey.shape[1], grey.shape[0], SIDE_PX))
    points, descriptors = cv2.SIFT.create(_FEATURES).detectAndCompute(grey, None)
    px = np.array([point.pt for point in points], np.float64).reshape(-1, 2)
    side = max(grey.shape)
    middle = (np.array(grey.shape[::-1]) - 1) / 2
    focal = photo.focal_px / max(photo.width, photo.height) if photo.focal_px else _FOCAL
    described = None if descriptors is None else np.asarray(descriptors, np.float32)
    return (px - middle) / side, described, focal


def _matched(
    first: Features, second: Features
) -> tuple[NDArray[np.float64], NDArray[np.float64], float, float] | None:
    """(matches that fit an epipolar geometry, in both photographs [M, 2]; focal lengths), or None
    for a pair that shows too little."""
    if first[1] is None or second[1] is None or min(len(first[1]), len(second[1])) < 2:
        return None
    nearest = cv2.BFMatcher().knnMatch(first[1], second[1], k=2)
    good = [one for one, other in nearest if one.distance < _RATIO * other.distance]
    if len(good) < _FEWEST_MATCHES:
        return None
    a = first[0][[match.queryIdx for match in good]]
    b = second[0][[match.trainIdx for match in good]]
    found: tuple[Any, Any] = cv2.findFundamentalMat(
        SIDE_PX * a, SIDE_PX * b, cv2.FM_RANSAC, _AWAY_PX, 0.999, 2000
    )
    fit = np.zeros(len(a), bool) if found[1] is None else found[1].ravel() > 0
    moved = np.linalg.norm((b - a)[fit], axis=1)
    if fit.sum() < _FEWEST_MATCHES or np.median(moved) < _LEAST_MOTION:
        return None
    return a[fit], b[fit], first[2], second[2]


def _same_place(
    a: NDArray[np.float64], b: NDArray[np.float64], focal_a: float, focal_b: float
) -> tuple[float, float]:
    """(the share of the matches a, b [M, 2] that a rotation and two focal lengths explain, the
    ratio of the longer to the shorter)."""
    limit = np.log(_FOCAL_RANGE)

    def away(x: NDArray[np.float64]) -> NDArray[np.float64]:
        rays = np.column_stack([a, np.full(len(a), focal_a * np.exp(x[3]))])
        turned = Rotation.from_rotvec(x[:3]).apply(rays)
        projected = focal_b * np.exp(x[4]) * turned[:, :2] / np.maximum(turned[:, 2:], 1e-6)
        return np.asarray((projected - b).ravel(), np.float64)

    best = (0.0, 1.0)
    for zoom in (0.0, -limit / 2, limit / 2):
        bounds = np.array([np.pi] * 3 + [limit] * 2)
        found = least_squares(
            away,
            np.array([0.0, 0.0, 0.0, -zoom, zoom]),
            loss="cauchy",
            f_scale=_AWAY_PX / SIDE_PX,
            bounds=(-bounds, bounds),
            max_nfev=60,
        ).x
        distance = np.linalg.norm(away(found).reshape(-1, 2), axis=1)
        ratio = abs(np.log(focal_b / focal_a) + found[4] - found[3])
        best = max(best, (float((distance < _AWAY_PX / SIDE_PX).mean()), float(np.exp(ratio))))
    return best
