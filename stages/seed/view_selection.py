"""Selects the views that splats are seeded from, and the source views of each for a plane sweep.

Both follow from the rays to a sample of the sparse points. A part of many views is enough, which
bounds the time. Views are chosen one after the other, each with its source views: the next is the
one that sees most points from directions that no chosen view has.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from stages.scene import Camera, View
from stages.seed.projection import visible_points

MOST_VIEWS = 60  # that splats are seeded from
SOURCES = 4  # source views of each reference view
# Triangulation angle in degrees: the best one, and the spread below and above it.
BEST_ANGLE, ANGLE_SPREAD = 10.0, (4.0, 8.0)
FEWEST_SHARED = 20  # sparse points seen by both views
SAMPLE = 1000  # sparse points by which views are selected


class Observations:
    """Which of P sampled sparse points each of V cameras sees, and from where.

    visible [V, P]; rays [V, P, 3] from the camera to the point, of length 1.
    """

    def __init__(self, cameras: Sequence[Camera], points: NDArray[np.float64]) -> None:
        count = min(SAMPLE, len(points))
        points = points[np.unique(np.linspace(0, len(points) - 1, count).round().astype(int))]
        self.visible = np.zeros((len(cameras), len(points)), bool)
        self.rays = np.zeros((len(cameras), len(points), 3))
        for i, camera in enumerate(cameras):
            self.visible[i, visible_points(camera, points)[0]] = True
            towards = points - camera.centre
            self.rays[i] = towards / np.maximum(np.linalg.norm(towards, axis=1)[:, None], 1e-12)

    def angles(self, i: int) -> NDArray[np.float64]:
        """[V, P] triangulation angle in degrees of view `i` and each view, at each point."""
        return np.asarray(np.degrees(np.arccos(np.clip((self.rays[i] * self.rays).sum(2), -1, 1))))

    def sources(self, i: int) -> list[int]:
        """Source views of view `i`: those with many shared points at a good triangulation angle."""
        angle = self.angles(i)
        spread = np.where(angle < BEST_ANGLE, *ANGLE_SPREAD)
        fitness = np.exp(-(((angle - BEST_ANGLE) / spread) ** 2) / 2)
        both = self.visible[i] & self.visible
        score = np.where(both.sum(1) >= FEWEST_SHARED, (fitness * both).sum(1), 0.0)
        score[i] = 0.0
        order = np.argsort(-score, kind="stable")[:SOURCES]
        return [int(j) for j in order if score[j] > 0.02 * self.visible[i].sum()]


def selected_views(
    views: Sequence[View], points: NDArray[np.float64], most: int = MOST_VIEWS
) -> tuple[View, ...]:
    """At most `most` of the views, which together see the sparse points [P, 3] from all sides."""
    ordered = sorted(views, key=lambda view: view.name)
    if len(ordered) <= most:
        return tuple(ordered)
    observations = Observations([view.camera for view in ordered], points)
    # [V, P] degrees to the nearest ray of a chosen view; 180 to a point that none sees
    nearest = np.where(observations.visible, 180.0, 0.0)
    chosen: list[int] = []
    while len(chosen) < most:
        gain = nearest.sum(1)
        gain[chosen] = -1.0
        best = int(gain.argmax())
        for i in [best, *observations.sources(best)]:
            if i not in chosen and len(chosen) < most:
                chosen.append(i)
                angles = np.where(observations.visible[i], observations.angles(i), 180.0)
                nearest = np.minimum(nearest, angles)
    return tuple(ordered[i] for i in sorted(chosen))
