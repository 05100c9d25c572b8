"""The turn to y up moves everything together."""

from __future__ import annotations

import numpy as np

from stages.scene.flip import flipped
from tests.formats.truth import colour, covariance, many_splats, red_splat

F = np.diag([1.0, -1.0, -1.0])


def test_turning_twice_changes_nothing() -> None:
    splats = many_splats()
    back = flipped(flipped(splats))
    for name in ("means", "quaternions", "log_scales", "opacity_logits", "sh", "origin"):
        np.testing.assert_array_equal(getattr(back, name), getattr(splats, name))


def test_up_becomes_plus_y_and_handedness_stays() -> None:
    up_in_our_world = np.array([0.0, -1.0, 0.0])
    splats = red_splat()
    splats.means[0] = up_in_our_world
    np.testing.assert_array_equal(flipped(splats).means[0], [0, 1, 0])
    assert np.linalg.det(F) == 1


def test_ellipsoids_turn_with_the_world() -> None:
    splats = many_splats(40)
    after = flipped(splats)
    for i in range(len(splats)):
        before = covariance(splats.quaternions[i], np.exp(splats.log_scales[i]))
        now = covariance(after.quaternions[i], np.exp(after.log_scales[i]))
        np.testing.assert_allclose(now, F @ before @ F.T, atol=1e-7)


def test_colours_seen_from_the_turned_direction_are_the_same() -> None:
    splats = many_splats(8)
    after = flipped(splats)
    rng = np.random.default_rng(0)
    for i in range(len(splats)):
        direction = rng.normal(size=3)
        np.testing.assert_allclose(
            colour(after.sh[i], F @ direction), colour(splats.sh[i], direction), atol=1e-6
        )
