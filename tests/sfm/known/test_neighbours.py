"""Which views with known cameras are matched."""

from __future__ import annotations

import numpy as np

from stages.ingest.faces import face_rotation
from stages.scene.camera import look_at
from stages.sfm.known.reconstruct import EXHAUSTIVE_UP_TO, neighbours

FACES = [face_rotation(*at) for at in ((0, 0), (90, 0), (270, 0), (0, 90), (0, -90))]


def row(photographs: int) -> np.ndarray:
    """[V, 4, 4] poses of cameras in a row that look the same way."""
    places = [np.array([0.3 * i, 0.0, 0.0]) for i in range(photographs)]
    return np.array([look_at(place, place + np.array([0.0, 0.0, 1.0])) for place in places])


def faces(photographs: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(poses, faces, photographs) of fisheyes in a row."""
    turns = np.tile(np.eye(4), (len(FACES), 1, 1))
    turns[:, :3, :3] = FACES
    poses = np.concatenate([turns @ pose for pose in row(photographs)])
    numbers = np.repeat(np.arange(photographs), len(FACES))
    return poses, np.tile(FACES, (photographs, 1, 1)), numbers


def test_faces_of_one_photograph_are_not_matched() -> None:
    for photographs in (3, 12):
        poses, turns, numbers = faces(photographs)
        found = np.array(neighbours(poses, turns, numbers))
        assert (found[:, 0] < found[:, 1]).all()
        assert (numbers[found[:, 0]] != numbers[found[:, 1]]).all()
        assert len(np.unique(found, axis=0)) == len(found)


def test_the_same_faces_of_photographs_next_in_order_are_matched_whatever_the_poses() -> None:
    poses, turns, numbers = faces(12)
    wrong = poses[np.random.default_rng(0).permutation(len(poses))]
    found = set(neighbours(wrong, turns, numbers))
    for photograph in range(11):
        for face in range(5):
            assert (5 * photograph + face, 5 * photograph + 5 + face) in found
    assert len(found) < 60 * 59 / 4  # by far not all


def test_of_few_photographs_all_are_matched() -> None:
    count = EXHAUSTIVE_UP_TO
    poses, turns = row(count), np.tile(np.eye(3), (count, 1, 1))
    assert len(neighbours(poses, turns, np.arange(count))) == count * (count - 1) // 2
