"""A turn around the scene keeps the photographs' distance and height, and its horizon."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from stages.scene import Camera, look_at
from stages.viewer.orbit import (
    arc_seen,
    common_lens,
    focus,
    orbit,
)
from tests import scenes

SPLATS = scenes.cloud(30)
MIDDLE = np.array([1.0, 2.0, -3.0])


def around(
    degrees: np.ndarray, distance: float = 4.0, slope_deg: float = 20.0
) -> tuple[Camera, ...]:
    """Cameras that look at MIDDLE from these directions, from +z towards +x."""
    made = []
    for angle, slope in zip(np.radians(degrees), itertools.repeat(np.radians(slope_deg))):
        level = np.cos(slope)
        ray = np.array([level * np.sin(angle), -np.sin(slope), level * np.cos(angle)])
        matrix = look_at(MIDDLE + distance * ray, MIDDLE)
        made.append(Camera(64, 48, 50.0, 50.0, 30.0, 25.0, matrix))
    return tuple(made)


ALL_AROUND = around(np.arange(0, 360, 30) + 7.0)


def centres(cameras: tuple[Camera, ...]) -> np.ndarray:
    return np.array([camera.centre for camera in cameras])


def test_cameras_that_look_at_one_point_agree_on_it() -> None:
    np.testing.assert_allclose(focus(ALL_AROUND, SPLATS), MIDDLE, atol=1e-9)


def test_cameras_that_look_side_by_side_still_have_a_focus() -> None:
    """Parallel axes meet nowhere: then what the pictures show decides, here 7 to 11 ahead."""
    side_by_side = [
        Camera(64, 48, 50.0, 50.0, 32.0, 24.0, look_at(np.array([x, 0, -5]), np.array([x, 0, 0])))
        for x in (-0.2, 0.0, 0.2)
    ]
    found = focus(side_by_side, SPLATS)
    near, far = SPLATS.means[:, 2].min(), SPLATS.means[:, 2].max()
    np.testing.assert_allclose(found[:2], 0, atol=1e-9)
    assert near + 1 < found[2] < far - 1


def test_every_frame_looks_level_at_the_focus_from_the_same_distance() -> None:
    frames = orbit(ALL_AROUND, SPLATS, 17)
    assert len(frames) == 17
    for frame in frames:
        rotation = frame.world_to_camera[:3, :3]
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(rotation) > 0
        assert abs(rotation[0, 1]) < 1e-12  # right is horizontal
        assert rotation[1, 1] > 0  # the picture's down is the world's
        away = frame.centre - MIDDLE
        assert np.linalg.norm(away) == pytest.approx(4.0)
        assert -away[1] == pytest.approx(4.0 * np.sin(np.radians(20)))
        np.testing.assert_allclose(frame.forward, -away / 4.0, atol=1e-12)


def test_a_turn_starts_at_the_first_camera_and_closes_without_a_jump() -> None:
    frames = orbit(ALL_AROUND, SPLATS, 36)
    np.testing.assert_allclose(frames[0].centre, ALL_AROUND[0].centre, atol=1e-9)
    ring = centres(frames)
    steps = np.linalg.norm(np.roll(ring, -1, axis=0) - ring, axis=1)
    np.testing.assert_allclose(steps, steps[0])
    angles = np.unwrap(np.arctan2(*(ring - MIDDLE)[:, [0, 2]].T))
    assert np.ptp(angles) == pytest.approx(2 * np.pi * 35 / 36)


def test_a_turn_is_nearer_and_higher_on_the_side_where_the_photographs_were() -> None:
    """As in a courtyard: on one side a wall is 2 behind the subject, on the other 6."""
    near = around(np.arange(-80, 81, 20), distance=2.0, slope_deg=40.0)
    far = around(np.arange(100, 261, 20), distance=6.0, slope_deg=10.0)
    frames = orbit(near + far, SPLATS, 4)  # from -80 degrees on
    away = centres(frames) - MIDDLE
    distances = np.linalg.norm(away, axis=1)
    heights = np.degrees(np.arcsin(-away[:, 1] / distances))
    assert distances[1] == pytest.approx(2.0, abs=0.05)  # at 10 degrees
    assert distances[3] == pytest.approx(6.0, abs=0.05)
    assert heights[1] == pytest.approx(40.0, abs=1.0)
    assert heights[3] == pytest.approx(10.0, abs=1.0)
    for frame in frames:
        assert abs(frame.world_to_camera[0, 1]) < 1e-12


@pytest.mark.parametrize("turned", [0.0, 100.0, 200.0])
def test_the_path_around_half_a_capture_swings_within_it(turned: float) -> None:
    """Seen from -60 to 60 degrees: to and fro within, however the world is turned, as a loop."""
    frames = orbit(around(np.linspace(-60, 60, 9) + turned), SPLATS, 40)
    away = centres(frames) - MIDDLE
    degrees = np.degrees(np.arctan2(away[:, 0], away[:, 2])) - turned
    degrees = (degrees + 180) % 360 - 180
    assert -60 < degrees.min() < -50
    assert 50 < degrees.max() < 60
    jumps = np.abs(np.diff(degrees, append=degrees[0]))
    assert jumps.max() < 10


def test_the_arc_is_the_whole_turn_unless_a_third_is_missing() -> None:
    assert arc_seen(ALL_AROUND, SPLATS)[1] == np.pi
    assert arc_seen(around(np.arange(0, 280, 20)), SPLATS)[1] == np.pi
    assert arc_seen(around(np.arange(0, 240, 20)), SPLATS)[1] < np.radians(110)
    assert arc_seen(ALL_AROUND[:1], SPLATS)[1] == np.pi


def test_a_capture_from_straight_above_still_has_a_horizon() -> None:
    frames = orbit(around(np.arange(0, 360, 40), slope_deg=89.9), SPLATS, 5)
    for frame in frames:
        assert np.isfinite(frame.world_to_camera).all()
        assert abs(frame.world_to_camera[0, 1]) < 1e-12


def test_the_lens_is_the_commonest_and_looks_through_the_middle() -> None:
    odd = Camera(480, 640, 9.0, 9.0, 1.0, 1.0, np.eye(4))
    lens = common_lens([odd, *ALL_AROUND])
    assert (lens.width, lens.height, lens.fx, lens.cx, lens.cy) == (64, 48, 50.0, 32.0, 24.0)
