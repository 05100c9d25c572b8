"""A path from camera to camera goes through all of them, evenly, and without turning over."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from stages.scene import Camera, View, look_at
from stages.viewer.camera_paths import (
    interpolated,
    length_in_turns,
    levelled,
    smoothed_path,
    tour,
)
from stages.viewer.render_cameras import Duration, path_cameras
from tests import scenes
from tests.sfm.synthetic import random_rotation

SPLATS = scenes.cloud(30)


def camera(eye: object, target: object = (0.0, 0.0, 0.0), up: object = (0.0, -1.0, 0.0)) -> Camera:
    matrix = look_at(*(np.array(v, float) for v in (eye, target, up)))
    return Camera(64, 48, 50.0, 50.0, 32.0, 24.0, matrix)


def wandering(count: int = 9, seed: int = 3) -> list[Camera]:
    """Unevenly spaced around the scene, held crooked."""
    rng = np.random.default_rng(seed)
    angles = np.sort(rng.uniform(0, 5, count))
    ups = rng.normal((0, -1, 0), 0.2, (count, 3))
    return [
        camera((4 * np.sin(a), rng.uniform(-2, 0), 4 * np.cos(a)), up=up)
        for a, up in zip(angles, ups, strict=True)
    ]


def turn_deg(a: Camera, b: Camera) -> float:
    cosine = (np.trace(a.world_to_camera[:3, :3] @ b.world_to_camera[:3, :3].T) - 1) / 2
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


def apart(a: Camera, b: Camera, reach: float = 4.0) -> float:
    return float(np.hypot(np.linalg.norm(a.centre - b.centre), reach * np.radians(turn_deg(a, b))))


def test_the_path_begins_and_ends_at_the_ends_and_passes_all_between() -> None:
    given = wandering()
    frames = interpolated(given, SPLATS, 400)
    assert len(frames) == 400
    for end, frame in ((given[0], frames[0]), (given[-1], frames[-1])):
        np.testing.assert_allclose(frame.world_to_camera, end.world_to_camera, atol=1e-9)
    step = max(apart(a, b) for a, b in itertools.pairwise(frames))
    for one in given:
        assert min(apart(one, frame) for frame in frames) < step


def test_speed_is_constant_and_nothing_flips() -> None:
    frames = interpolated(wandering(), SPLATS, 300)
    steps = np.array([apart(a, b) for a, b in itertools.pairwise(frames)])
    assert steps.max() < 1.1 * np.median(steps)
    assert max(turn_deg(a, b) for a, b in itertools.pairwise(frames)) < 5
    for frame in frames:
        rotation = frame.world_to_camera[:3, :3]
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(rotation) > 0


def test_cameras_on_a_line_give_a_line() -> None:
    given = [camera((x, 0, -5), (x, 0, 0)) for x in (0.0, 0.1, 2.0, 2.5)]
    frames = interpolated(given, SPLATS, 26)
    np.testing.assert_allclose(
        [f.centre for f in frames], [(0.1 * i, 0, -5) for i in range(26)], atol=5e-3
    )
    assert max(turn_deg(frames[0], frame) for frame in frames) < 1e-5


def test_the_shorter_way_round_is_taken() -> None:
    """Quaternions of 170 and 190 degrees about y may have opposite signs: 20 degrees apart."""
    ends = [camera((np.sin(a), 0, np.cos(a)), (0, 0, 0)) for a in np.radians((170, 190))]
    frames = interpolated(ends, SPLATS, 11)
    assert max(turn_deg(a, b) for a, b in itertools.pairwise(frames)) < 2.5


@pytest.mark.parametrize("count", [1, 2, 3])
def test_cameras_in_one_place_give_a_path_without_motion(count: int) -> None:
    frames = interpolated([camera((0, 0, -5))] * count, SPLATS, 4)
    assert len(frames) == 4
    for frame in frames:
        np.testing.assert_allclose(frame.centre, (0, 0, -5), atol=1e-12)


def test_levelling_keeps_place_and_direction() -> None:
    for one in wandering():
        level = levelled(one)
        np.testing.assert_allclose(level.centre, one.centre, atol=1e-12)
        np.testing.assert_allclose(level.forward, one.forward, atol=1e-12)
        assert abs(level.world_to_camera[0, 1]) < 1e-12
        assert level.world_to_camera[1, 1] > 0


def test_upside_down_is_put_upright_and_straight_down_is_left_alone() -> None:
    assert levelled(camera((0, 0, -5), up=(0, 1, 0))).world_to_camera[1, 1] > 0.99
    down = camera((0, -5, 0), up=(1, 0, 0))
    np.testing.assert_allclose(levelled(down).world_to_camera, down.world_to_camera)


def test_levelling_does_not_jump_as_a_camera_tilts_down() -> None:
    slopes = np.radians(np.arange(60, 90, 0.5))
    tilted = [
        camera((0.0, -np.sin(s), -np.cos(s)), up=(0.3, -np.cos(s), np.sin(s))) for s in slopes
    ]
    frames = [levelled(one) for one in tilted]
    assert max(turn_deg(a, b) for a, b in itertools.pairwise(frames)) < 3


def test_a_walk_in_order_is_kept() -> None:
    walk = [camera((4 * np.sin(a), -1, 4 * np.cos(a))) for a in np.linspace(0, 5, 12)]
    assert tour(walk, SPLATS).tolist() == list(range(12))


@pytest.mark.parametrize("seed", range(5))
def test_names_in_no_order_are_put_in_the_order_of_a_walk(seed: int) -> None:
    shuffled = np.random.default_rng(seed).permutation(20)
    places = np.linspace(0, 5, 20)
    cameras = [camera((4 * np.sin(a), -1, 4 * np.cos(a))) for a in places[shuffled]]
    order = tour(cameras, SPLATS)
    walked = shuffled[order]
    assert sorted(order) == list(range(20))
    assert walked.tolist() in (list(range(20)), list(range(20))[::-1])


def test_one_or_two_cameras_have_an_order_too() -> None:
    assert tour(wandering(1), SPLATS).tolist() == [0]
    assert tour(wandering(2), SPLATS).tolist() == [0, 1]


def test_a_steady_path_ends_where_it_did_and_turns_corners_gently() -> None:
    corner = [(x, 0, -5) for x in np.linspace(-2, 0, 60)]
    corner += [(0, y, -5) for y in np.linspace(0, -2, 60)]
    hand = [camera((x, y, -5), (x, y, -4)) for x, y, _ in corner]
    steady = smoothed_path(hand, 6.0)

    def kink(path) -> float:
        distorts = np.diff([c.centre for c in path], 2, axis=0)
        return float(np.linalg.norm(distorts, axis=1).max())

    assert kink(steady) < 0.2 * kink(hand)
    for i in (0, -1):
        np.testing.assert_allclose(steady[i].centre, hand[i].centre, atol=1e-9)
    far = max(np.linalg.norm(a.centre - b.centre) for a, b in zip(steady, hand, strict=True))
    assert far < 0.3
    assert len(smoothed_path(hand[:1], 6.0)) == 1


def test_few_frames_go_the_same_way_past_the_photographs() -> None:
    """Twelve frames of a turn lie on the film of 240, and so at the cameras' distance."""
    ring = [camera((4 * np.sin(a), 0, 4 * np.cos(a))) for a in np.linspace(0, 2 * np.pi, 24)]
    views = [View(f"{k}", f"{k}.jpg", seen) for k, seen in enumerate(ring)]
    film, stills = (
        np.array([c.centre for c in path_cameras("capture", SPLATS, views, Duration(n)).cameras])
        for n in (240, 12)
    )
    assert len(stills) == 12
    np.testing.assert_allclose(np.linalg.norm(stills[1:-1], axis=1), 4.0, atol=0.1)
    apart = np.linalg.norm(stills[:, None] - film[None], axis=2).min(1)
    assert apart.max() < 0.15  # the film's frames are 0.1 apart


def test_a_full_turn_is_one_turn_long() -> None:
    """By hand: the way and the camera's own turn are both 2 pi x 4, together sqrt(2) turns."""
    ring = [camera((4 * np.sin(a), 0, 4 * np.cos(a))) for a in np.linspace(0, 2 * np.pi, 90)]
    assert length_in_turns(ring, SPLATS) == pytest.approx(np.sqrt(2), rel=1e-3)


def test_a_random_rotation_survives_the_path() -> None:
    matrix = np.eye(4)
    matrix[:3, :3] = random_rotation(5)
    one = Camera(64, 48, 50.0, 50.0, 32.0, 24.0, matrix)
    np.testing.assert_allclose(
        interpolated([one], SPLATS, 1)[0].world_to_camera, matrix, atol=1e-12
    )
