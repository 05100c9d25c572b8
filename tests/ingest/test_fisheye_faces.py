"""Which faces show the field of view of a fisheye."""

from __future__ import annotations

import numpy as np
import pytest

from stages.cameras.lens import Lens
from stages.ingest.fisheye_faces import Field, FisheyeFace, faces_of, only_face, shown_share
from tests.sfm.fisheyes import EQUIDISTANT, LENS, camera

CUBE = ["000+00", "090+00", "270+00", "000+90", "000-90"]


def sees(face: FisheyeFace, directions: np.ndarray) -> np.ndarray:
    """[N] whether the directions lie in the picture of a face."""
    x, y, z = face.rotation @ directions.T
    with np.errstate(divide="ignore", invalid="ignore"):
        c = face.camera
        u, v = c.fx * x / z + c.cx, c.fy * y / z + c.cy
    return np.asarray((z > 0) & (u >= 0) & (u <= c.width) & (v >= 0) & (v <= c.height))


def random_directions(field: Field, count: int = 20_000) -> np.ndarray:
    """Those that a photograph shows, of so many."""
    found = np.random.default_rng(0).normal(size=(count, 3))
    found /= np.linalg.norm(found, axis=1, keepdims=True)
    return np.asarray(found[field.shows(found)[1]])


@pytest.mark.parametrize(
    ("size", "degrees", "radius", "names"),
    [
        ((1200, 800), 150, np.inf, ["330+00", "030+00"]),
        ((800, 1200), 100, np.inf, ["000+30", "000-30"]),
        ((800, 800), 180, 400, CUBE),
        ((800, 800), 220, 400, CUBE),
        ((800, 800), 300, 400, [*CUBE, "180+00"]),
        ((800, 600), 180, np.inf, CUBE),
    ],
)
def test_faces_show_the_whole_field_of_view_and_their_middle_most_of_it(
    size: tuple[int, int], degrees: float, radius: float, names: list[str]
) -> None:
    field = Field(camera(*size, degrees), EQUIDISTANT, radius)
    faces = faces_of(field)
    assert [face.name for face in faces] == names
    directions = random_directions(field)
    seen = np.any([sees(face, directions) for face in faces], axis=0)
    assert seen.mean() > 0.998
    assert shown_share(field, faces) == pytest.approx(seen.mean(), abs=2e-3)
    if len(names) > 2:
        assert seen.all()


def test_a_face_of_a_distorting_lens_is_cropped_to_what_is_seen() -> None:
    field = Field(camera(900, 900, 190), LENS, 440)
    faces = faces_of(field)
    for face in faces:
        inside = field.shows(face.rays())[1]
        assert face.whole == inside.all()
        assert inside.any(axis=0).all()
        assert inside.any(axis=1).all()
    directions = random_directions(field)
    assert np.any([sees(face, directions) for face in faces], axis=0).all()


@pytest.mark.parametrize(
    ("size", "degrees", "radius"),
    [((800, 600), 90, np.inf), ((1200, 800), 130, np.inf), ((800, 800), 140, 400)],
)
def test_one_pinhole_is_enough_where_it_shows_three_quarters(
    size: tuple[int, int], degrees: float, radius: float
) -> None:
    assert faces_of(Field(camera(*size, degrees), EQUIDISTANT, radius)) == ()


def test_the_only_picture_of_a_narrow_circle_ends_at_it() -> None:
    """By hand: the corner of a square that reaches 60 degrees to its sides lies at 67.8."""
    taken = camera(800, 800, 120)
    assert not only_face(Field(taken, EQUIDISTANT, 400)).whole
    assert only_face(Field(taken, EQUIDISTANT, 460)).whole


def test_a_lens_that_folds_is_used_up_to_there() -> None:
    """By hand: a (1 - a^2 / 9) is largest at a = sqrt(3), 99 degrees, where it is 2 / sqrt(3)."""
    lens = Lens("fisheye", (-1 / 9,))
    taken = camera(800, 800, 180)
    field = Field(taken, lens)
    assert field.angle == pytest.approx(np.sqrt(3), abs=0.01)
    directions = field.directions()
    assert np.arccos(directions[:, 2]).max() <= field.angle + 1e-9
    edge = 2 / np.sqrt(3) * taken.fx
    x, y = np.meshgrid(np.arange(800) + 0.5, np.arange(800) + 0.5)
    beyond = np.hypot(x - 400, y - 400) > edge
    assert field.folded_share() == pytest.approx(beyond.mean(), abs=0.01)
    assert len(faces_of(field)) == 5
    assert Field(taken, EQUIDISTANT).folded_share() == 0.0
