"""Splats to start from where a photograph shows a surface that has no points."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from stages.base.stage import Report
from stages.scene import Camera, Reconstruction, View, look_at
from stages.seed import stage as seed
from stages.seed.colour_evidence import CELLS
from stages.seed.empty_cells import MARGIN, fill_cells
from stages.seed.settings import SeedSettings

WIDTH, HEIGHT = 80, 60
FLOOR = 1.0  # y of the floor; up is -y
EYES = ((-1.0, -1.5, -3.0), (1.0, -1.5, -3.0))
COLOURS = ((200, 40, 40), (40, 40, 200))


def floor_points() -> np.ndarray:
    """A patch in the middle of what the cameras see, with a little noise."""
    random = np.random.default_rng(3)
    xz = random.uniform(-1.0, 1.0, (300, 2))
    heights = FLOOR + random.normal(0, 0.002, 300)
    return np.stack([xz[:, 0], heights, xz[:, 1]], 1)


def views(folder: Path, eyes=EYES) -> tuple[View, ...]:
    """Cameras that look down on the floor, steeply enough to see no horizon; one colour each."""
    made = []
    for number, eye in enumerate(eyes):
        name = f"{number}.png"
        Image.new("RGB", (WIDTH, HEIGHT), COLOURS[number % 2]).save(folder / name)
        matrix = look_at(np.array(eye), np.array([0.0, FLOOR, 0.0]))
        made.append(View(name, name, Camera(WIDTH, HEIGHT, 110.0, 110.0, 40.0, 30.0, matrix)))
    return tuple(made)


def cells_hit(view: View, points: np.ndarray) -> np.ndarray:
    """[rows, columns] of the view's cells: whether a point lands there."""
    camera = view.camera.fitted(CELLS)
    at = points @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    x = np.floor(at[:, 0] / at[:, 2] * camera.fx + camera.cx).astype(int)
    y = np.floor(at[:, 1] / at[:, 2] * camera.fy + camera.cy).astype(int)
    inside = (at[:, 2] > 0) & (x >= 0) & (y >= 0) & (x < camera.width) & (y < camera.height)
    hit = np.zeros((camera.height, camera.width), bool)
    hit[y[inside], x[inside]] = True
    return hit


def in_picture(camera: Camera, points: np.ndarray) -> np.ndarray:
    at = points @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    x = at[:, 0] / at[:, 2] * camera.fx + camera.cx
    y = at[:, 1] / at[:, 2] * camera.fy + camera.cy
    return (at[:, 2] > 0) & (x >= 0) & (y >= 0) & (x < camera.width) & (y < camera.height)


def test_most_cells_of_a_photograph_end_up_with_a_point(tmp_path: Path) -> None:
    """A quarter had one. A cell stays empty where the other photograph contradicts every guess."""
    both, points = views(tmp_path), floor_points()
    more, _, _ = fill_cells(tmp_path, both, points)
    for view in both:
        assert cells_hit(view, points).mean() < 0.3
        assert cells_hit(view, np.concatenate([points, more])).mean() > 0.75


def test_nothing_is_added_where_points_already_are(tmp_path: Path) -> None:
    both, points = views(tmp_path), floor_points()
    more, _, _ = fill_cells(tmp_path, both[:1], points)
    assert not (cells_hit(both[0], more) & cells_hit(both[0], points)).any()
    once, _, _ = fill_cells(tmp_path, both, points)
    again, _, _ = fill_cells(tmp_path, both, np.concatenate([points, once]))
    assert len(again) < 0.1 * len(once)


def test_a_plane_is_extrapolated_where_two_photographs_support_it(tmp_path: Path) -> None:
    both, points = views(tmp_path), floor_points()
    more, _, _ = fill_cells(tmp_path, both, points)
    inside = in_picture(both[0].camera, more) & in_picture(both[1].camera, more)
    off = np.abs(towards_the_floor(both[0], more)[inside] - 1)
    assert inside.sum() > 400
    assert np.median(off) < 0.005
    assert np.percentile(off, 90) < 0.01


@pytest.mark.parametrize("count", [1, 2])
def test_nothing_is_put_before_the_floor(tmp_path: Path, count: int) -> None:
    """Where nobody confirms a guess it goes as far back as the photograph sees: a guess too near
    would grow into a cloud before all cameras that look past it."""
    some, points = views(tmp_path)[:count], floor_points()
    more, _, _ = fill_cells(tmp_path, some, points)
    for view in some:
        inside = in_picture(view.camera, more)
        assert towards_the_floor(view, more)[inside].max() < 1.02


def towards_the_floor(view: View, points: np.ndarray) -> np.ndarray:
    """[N] distance to the floor along the ray to each point, over the point's own: 1 on the floor,
    more where a point hangs before it."""
    rays = points - view.camera.centre
    return np.asarray((FLOOR - view.camera.centre[1]) / rays[:, 1])


def test_colours_come_from_the_photograph_and_sizes_from_its_cells(tmp_path: Path) -> None:
    both, points = views(tmp_path), floor_points()
    more, colours, scales = fill_cells(tmp_path, both[:1], points)
    assert len(more) == len(colours) == len(scales) > 0
    np.testing.assert_allclose(
        colours, np.tile(np.array(COLOURS[0]) / 255, (len(more), 1)), atol=1e-6
    )
    depth = (more - both[0].camera.centre) @ both[0].camera.forward
    cell = depth / both[0].camera.fitted(CELLS).fx
    np.testing.assert_allclose(scales / cell, 0.5, rtol=1e-6)


def test_each_cell_has_the_colour_of_its_own_pixel(tmp_path: Path) -> None:
    both, points = views(tmp_path), floor_points()
    picture = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    picture[:, : WIDTH // 2, 0] = 255
    picture[: HEIGHT // 2, :, 1] = 255
    Image.fromarray(picture).save(tmp_path / both[0].image)
    more, colours, _ = fill_cells(tmp_path, both[:1], points)
    camera = both[0].camera
    at = more @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    left, above = at[:, 0] < 0, at[:, 1] < 0
    np.testing.assert_allclose(colours, np.stack([left, above, 0 * left], 1), atol=1e-6)


def test_a_photograph_is_continued_a_little_beyond_its_rim(tmp_path: Path) -> None:
    both, points = views(tmp_path), floor_points()
    more, _, _ = fill_cells(tmp_path, both[:1], points)
    camera = both[0].camera
    at = more @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    x = at[:, 0] / at[:, 2] * camera.fx + camera.cx
    assert x.min() < 0
    assert x.max() > WIDTH
    assert x.min() > -1.01 * MARGIN * WIDTH
    assert x.max() < WIDTH * (1 + 1.01 * MARGIN)


def test_what_one_photograph_has_filled_counts_for_the_next(tmp_path: Path) -> None:
    both, points = views(tmp_path), floor_points()
    alone = sum(len(fill_cells(tmp_path, (view,), points)[0]) for view in both)
    together = len(fill_cells(tmp_path, both, points)[0])
    assert together < 0.8 * alone


def test_the_order_of_the_photographs_does_not_matter(tmp_path: Path) -> None:
    both, points = views(tmp_path), floor_points()
    for a, b in zip(
        fill_cells(tmp_path, both, points), fill_cells(tmp_path, both[::-1], points), strict=True
    ):
        assert np.asarray(a).tobytes() == np.asarray(b).tobytes()


@pytest.mark.parametrize("n", [0, 5])
def test_with_hardly_a_point_nothing_is_guessed(tmp_path: Path, n: int) -> None:
    more, colours, scales = fill_cells(tmp_path, views(tmp_path), floor_points()[:n])
    assert more.shape == (0, 3)
    assert colours.shape == (0, 3)
    assert scales.shape == (0,)


def test_held_out_photographs_lend_nothing(tmp_path: Path) -> None:
    """The first of five by name is held out: without its file the start is the same."""
    eyes = [(x, -1.5, -3.0) for x in (-1.0, -0.5, 0.0, 0.5, 1.0)]
    points = floor_points()
    reconstruction = Reconstruction(
        folder=tmp_path,
        views=views(tmp_path, eyes),
        points=points,
        colours=np.full(points.shape, 99, np.uint8),
        errors_px=np.full(len(points), 0.5),
        tracks=np.full(len(points), 4, np.int32),
    )
    made = []
    for name in ("with", "without"):
        (tmp_path / name).mkdir()
        report = Report()
        made.append(seed.run({"sfm": reconstruction}, SeedSettings(), tmp_path / name, report))
        assert len(made[-1]) == len(points) + report.metrics["filled_cells"]
        (tmp_path / reconstruction.views[0].image).unlink(missing_ok=True)
    assert made[0].means.tobytes() == made[1].means.tobytes()
    bare = seed.run(
        {"sfm": replace(reconstruction, folder=Path("nowhere"))},
        SeedSettings(fill=False),
        tmp_path / "with",
        Report(),
    )
    assert len(bare) == len(points)


def hoop_before_wall() -> np.ndarray:
    """Points of a bent hoop and of a wall far behind it, but for what is seen through the hoop."""
    random = np.random.default_rng(6)
    angle = random.uniform(0, 2 * np.pi, 80)
    hoop = np.c_[0.6 * np.cos(angle), 0.6 * np.sin(angle), random.uniform(2.0, 2.8, 80)]
    wall = np.c_[random.uniform(-5, 5, 2000), random.uniform(-4, 4, 2000), np.full(2000, 8.0)]
    return np.concatenate([hoop, wall[np.linalg.norm(wall[:, :2], axis=1) > 2.8]])


def facing(folder: Path, eyes: tuple[float, ...]) -> tuple[View, ...]:
    """Cameras at these x, side by side, that look at the wall."""
    made = []
    for number, x in enumerate(eyes):
        name = f"{number}.png"
        Image.new("RGB", (WIDTH, HEIGHT), COLOURS[0]).save(folder / name)
        matrix = look_at(np.array([x, 0.0, 0.0]), np.array([x, 0.0, 8.0]))
        made.append(View(name, name, Camera(WIDTH, HEIGHT, 50.0, 50.0, 40.0, 30.0, matrix)))
    return tuple(made)


def test_what_other_photographs_contradict_goes_to_the_back(tmp_path: Path) -> None:
    """The nearest points around the hoop's hole are the hoop's; who sees past it knows better."""
    several = facing(tmp_path, (0.0, -1.4, 1.4))
    more, _, _ = fill_cells(tmp_path, several, hoop_before_wall())
    through = more[np.abs(more[:, :2] / more[:, 2:]).max(1) < 0.1]
    assert len(through) > 10
    assert through[:, 2].min() > 7.0


def test_nothing_is_guessed_beyond_a_rim_where_another_photograph_looks(tmp_path: Path) -> None:
    (left, right), points = views(tmp_path), floor_points()
    alone, _, _ = fill_cells(tmp_path, (left,), points)
    beyond = alone[~in_picture(left.camera, alone)]
    assert in_picture(right.camera, beyond).any()
    both, _, _ = fill_cells(tmp_path, (left, right), points)
    at = ~in_picture(left.camera, both) & ~in_picture(right.camera, both)
    assert at.any()
    inside = both[: len(both) - at.sum()]  # what lies within a picture comes first
    assert (in_picture(left.camera, inside) | in_picture(right.camera, inside)).all()
