"""What measured points say of a place, as other photographs show them: is a surface there, or only
farther away? And does it hang in the air before a camera?"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from stages.scene import View
from stages.structure.seeding.projection import visible_points

SIDE = 320  # pixels: the scale at which nearest is meant
NEAREST = 6  # points
AGREE = 0.1  # of a depth
BELIEVED = 4  # times as many photographs must agree as contradict
ANCHORS, ANCHORED = 3, 0.2  # measured points within this share of the distance to a camera


class VisibilityConstraints:
    """The photographs, and the measured points that each of them shows."""

    def __init__(self, views: tuple[View, ...], points: NDArray[np.float64]) -> None:
        self._cameras = cKDTree(np.array([view.camera.centre for view in views]).reshape(-1, 3))
        self._points = cKDTree(points)
        self._known = []
        for view in views:
            camera = view.camera.fitted(SIDE)
            _, pixels, depths = visible_points(camera, points)
            if len(depths) >= NEAREST:
                self._known.append((view.name, camera, cKDTree(pixels), depths))

    def ask(
        self, places: NDArray[np.float64], of: str
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """For each place [K, 3], how many photographs but the one named `of` have a point at
        about its depth among the nearest around it in the picture; and for how many it hangs
        before all of these."""
        agree, before = np.zeros(len(places), np.int64), np.zeros(len(places), np.int64)
        for name, camera, tree, depths in self._known:
            rows, pixels, place_depths = visible_points(camera, places)
            if name == of or not len(rows):
                continue
            _, nearest = tree.query(pixels, NEAREST)
            ratio = place_depths[:, None] / depths[nearest]
            agree[rows] += (np.abs(ratio - 1) < AGREE).any(1)
            before[rows] += (ratio < 1 - AGREE).all(1)
        return agree, before

    def confirm(self, places: NDArray[np.float64], of: str = "") -> NDArray[np.bool_]:
        """[K] whether enough other photographs agree, and hardly any contradict."""
        agree, before = self.ask(places, of)
        return np.asarray(agree > BELIEVED * before)

    def anchored(self, places: NDArray[np.float64]) -> NDArray[np.bool_]:
        """[K] whether a place is much nearer to measured points than to any camera."""
        if not len(places) or self._points.n < ANCHORS:
            return np.zeros(len(places), bool)
        to_camera, _ = self._cameras.query(places)
        to_points, _ = self._points.query(places, ANCHORS)
        return np.asarray(to_points[:, -1] < ANCHORED * to_camera)
