"""A second attempt at mapping starts from the pair with most matches that sees enough parallax."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stages.scene import Capture, Photo
from stages.sfm.worker.job import Project, project_of

DEPTH = 10.0
# Places of four photographs that look along the third axis. Rays to the middle of the scene meet at
# 1 degree (0 and 1), 14 degrees (0 and 2) and 27 degrees (0 and 3).
PLACES = [(0.0, 0.0, 0.0), (0.2, 0.0, 0.0), (2.5, 0.0, 0.0), (5.0, 0.0, 0.0)]
MATCHES = {(1, 2): 400, (1, 3): 200, (1, 4): 100}


@contextmanager
def scene(folder: Path, places: list[tuple[float, float, float]]) -> Iterator[tuple[Project, Any]]:
    """(project, database) of photographs of the same 400 points from these places."""
    pycolmap = pytest.importorskip("pycolmap")
    from stages.sfm.worker import new_database

    names = [f"{number}.jpg" for number in range(len(places))]
    photos = tuple(
        Photo(name, f"photos/{name}", 640, 480, 500.0, "one", 1.0, 0.0, None) for name in names
    )
    project = project_of(Capture(folder, photos), folder, 0)
    new_database.create(project.database, project.photographs)
    low, high = (-3.0, -3.0, DEPTH - 2.0), (3.0, 3.0, DEPTH + 2.0)
    points = np.random.default_rng(0).uniform(low, high, (400, 3))
    with pycolmap.Database.open(project.database) as database:
        for image_id, place in enumerate(places, 1):
            x, y, z = (points - place).T
            pixels = np.stack([500.0 * x / z + 320.0, 500.0 * y / z + 240.0], 1)
            database.write_keypoints(image_id, pixels.astype(np.float32))
        yield project, database


def chosen(project: Project, database: Any, matches: dict[tuple[int, int], int]) -> Any:
    from stages.sfm.worker.initial_pair import strongest_pair

    verified = [(pair, np.arange(n)[:, None].repeat(2, 1)) for pair, n in matches.items()]
    return strongest_pair(project, database, verified)


def test_neighbours_see_too_little_parallax_and_far_photographs_share_too_little(
    tmp_path: Path,
) -> None:
    with scene(tmp_path, PLACES) as (project, database):
        assert chosen(project, database, MATCHES) == (1, 3)
        assert chosen(project, database, MATCHES | {(1, 4): 300}) == (1, 4)
        assert chosen(project, database, {(1, 2): 400}) is None
        assert chosen(project, database, {}) is None


def test_a_step_straight_on_is_no_initial_pair(tmp_path: Path) -> None:
    with scene(tmp_path, [PLACES[0], (0.0, 0.0, 5.0), PLACES[2]]) as (project, database):
        assert chosen(project, database, {(1, 2): 400, (1, 3): 100}) == (1, 3)


def test_faces_of_one_panorama_are_no_initial_pair(tmp_path: Path) -> None:
    with scene(tmp_path, PLACES) as (project, database):
        photographs = replace(project.photographs, frame_of=(0, 1, 0, 2))
        faces = replace(project, photographs=photographs)
        assert chosen(faces, database, MATCHES) == (1, 4)
