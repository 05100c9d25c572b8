"""The seed stage: one splat a point, sized by its neighbours, without outliers and giants."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stages.base.errors import Family, SplatError
from stages.base.stage import Report
from stages.scene import Camera, Reconstruction, Splats, View, dc_to_rgb, look_at
from stages.scene.rotations import matrices_of
from stages.seed import stage as seed
from stages.seed.neighbours import mean_neighbour_distance, nearest_distance
from stages.seed.settings import SeedSettings

BARE = SeedSettings(fill=False)  # the scenes below have no photographs


def grid(side: int = 8, spacing: float = 0.1) -> Reconstruction:
    """A plane of points `spacing` apart, seen by four cameras about 3 away."""
    i, j = np.meshgrid(np.arange(side), np.arange(side))
    points = np.stack([i, j, 0 * i], axis=-1).reshape(-1, 3) * spacing
    points = points - points.mean(axis=0)
    eyes = [(-1, -1, -3), (1, -1, -3), (-1, 1, -3), (1, 1, -3)]
    views = tuple(
        View(
            f"{n}.jpg",
            f"{n}.jpg",
            Camera(64, 48, 50, 50, 32, 24, look_at(np.array(e), np.zeros(3))),
        )
        for n, e in enumerate(np.array(eyes, float))
    )
    random = np.random.default_rng(0)
    return Reconstruction(
        folder=Path(),
        views=views,
        points=points,
        colours=random.integers(0, 256, points.shape).astype(np.uint8),
        errors_px=np.full(len(points), 0.5),
        tracks=np.full(len(points), 4, np.int32),
        origin=np.array([1e6, 2.0, -3.0]),
    )


def with_points(reconstruction: Reconstruction, extra: list[list[float]], **changes: float):
    """The reconstruction with points added at the end."""
    n = len(extra)
    return replace(
        reconstruction,
        points=np.concatenate([reconstruction.points, np.array(extra, float)]),
        colours=np.concatenate([reconstruction.colours, np.zeros((n, 3), np.uint8)]),
        errors_px=np.append(reconstruction.errors_px, [changes.get("error", 0.5)] * n),
        tracks=np.append(reconstruction.tracks, [int(changes.get("track", 4))] * n).astype(
            np.int32
        ),
    )


def run(reconstruction: Reconstruction, folder: Path) -> tuple[Splats, Report]:
    report = Report()
    return seed.run({"sfm": reconstruction}, BARE, folder, report), report


def test_a_grid_gives_splats_as_large_as_its_spacing(tmp_path: Path) -> None:
    scene = grid()
    splats, report = run(scene, tmp_path)
    assert len(splats) == 64
    inner = np.exp(splats.log_scales.reshape(8, 8, 3)[1:-1, 1:-1])
    assert np.allclose(inner, 0.1)
    assert np.allclose(splats.opacities, 0.1)
    assert np.allclose(dc_to_rgb(splats.sh[:, 0]), scene.colours / 255.0, atol=1e-6)
    normals = matrices_of(splats.quaternions)[:, :, 0]
    assert np.allclose(np.abs(normals), [0, 0, 1], atol=1e-6)  # the grid lies in this plane
    assert splats.sh.shape == (64, 1, 3)
    assert splats.sh_degrees.max() == 0
    assert splats.means.dtype == np.float32
    assert (splats.origin == scene.origin).all()
    assert report.metrics["outliers"] == 0


def test_where_a_held_out_photograph_stood_changes_nothing(tmp_path: Path) -> None:
    scene = grid()
    known = tuple(replace(view, role="train") for view in scene.views)
    found = []
    for name, eye in (("a", [0.0, 0.1, -0.2]), ("b", [40.0, -30.0, -5.0])):
        pose = look_at(np.array(eye), np.zeros(3))
        camera = replace(scene.views[0].camera, world_to_camera=pose)
        held = replace(scene.views[0], role="test", camera=camera)
        (tmp_path / name).mkdir()
        run(replace(scene, views=(*known, held)), tmp_path / name)
        found.append((tmp_path / name / "splats.bin").read_bytes())
    assert found[0] == found[1]


@pytest.mark.parametrize(
    ("point", "changes", "reason"),
    [
        ([0.0, 0.0, 1e4], {}, "far_away"),
        ([np.nan, 0.0, 0.0], {}, "not_finite"),
        ([np.inf, 0.0, 0.0], {}, "not_finite"),
        ([0.1, 0.1, 0.1], {"error": 3.9}, "high_error"),
        ([0.1, 0.1, 0.1], {"error": np.nan}, "high_error"),
        ([1.0, 1.0, -2.99], {}, "at_a_camera"),
        ([0.0, 0.0, 15.0], {"track": 2}, "far_away"),
    ],
)
def test_outlying_points_are_left_out_and_counted(
    tmp_path: Path, point: list[float], changes: dict[str, float], reason: str
) -> None:
    splats, report = run(with_points(grid(), [point], **changes), tmp_path)
    assert len(splats) == 64
    assert np.abs(splats.means).max() < 10
    assert report.metrics["outliers_by_reason"][reason] == 1


def test_a_background_seen_by_several_photographs_stays(tmp_path: Path) -> None:
    splats, _ = run(with_points(grid(), [[0.0, 0.0, 15.0]]), tmp_path)
    assert len(splats) == 65


def test_a_lonely_point_is_no_giant_and_duplicates_do_not_vanish(tmp_path: Path) -> None:
    duplicates = [[0.05, 0.05, 0.0]] * 5
    splats, report = run(with_points(grid(), [[0.0, 2.0, 4.0], *duplicates]), tmp_path)
    scales = np.exp(splats.log_scales[:, 0])
    assert scales[64] < 0.05 * 8  # 3 degrees as seen from the nearest camera, 7.3 away
    assert np.allclose(scales[65:], 0.1 * np.median(scales), rtol=0.2)
    assert report.metrics["scales_clamped"] >= 6


def test_too_few_points_are_an_error_with_advice(tmp_path: Path) -> None:
    scene = grid(side=6)
    with pytest.raises(SplatError) as error:
        run(scene, tmp_path)
    assert error.value.code == "seed-too-few-points"
    assert error.value.family == Family.RECONSTRUCTION
    with pytest.raises(SplatError):
        run(
            replace(
                scene,
                points=scene.points[:0],
                colours=scene.colours[:0],
                errors_px=scene.errors_px[:0],
                tracks=scene.tracks[:0],
            ),
            tmp_path,
        )
    with pytest.raises(SplatError):  # all in one place
        run(replace(grid(), points=np.zeros((64, 3))), tmp_path)


def test_same_input_same_bytes_and_load_gives_them_back(tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        splats, _ = run(grid(), tmp_path / name)
    files = [sorted(p for p in (tmp_path / name).iterdir()) for name in ("a", "b")]
    assert [p.read_bytes() for p in files[0]] == [p.read_bytes() for p in files[1]]
    loaded = seed.load(tmp_path / "a")
    assert (loaded.log_scales == splats.log_scales).all()


@given(st.integers(2, 60), st.integers(1, 4), st.integers(0, 10**6), st.booleans())
def test_neighbour_distances_are_those_of_brute_force(
    n: int, count: int, random_seed: int, crowded: bool
) -> None:
    random = np.random.default_rng(random_seed)
    points = random.normal(size=(n, 3)) * random.uniform(0.01, 10, 3)
    if crowded:
        points = np.round(points, 1)
    distances = np.linalg.norm(points[:, None] - points[None], axis=-1)
    np.fill_diagonal(distances, np.inf)
    wanted = np.sort(distances, axis=1)[:, : min(count, n - 1)].mean(axis=1)
    assert np.allclose(mean_neighbour_distance(points, count), wanted, atol=1e-12)


def test_a_single_point_has_no_neighbour() -> None:
    assert np.isinf(mean_neighbour_distance(np.zeros((1, 3)), 3)).all()
    assert len(mean_neighbour_distance(np.zeros((0, 3)), 3)) == 0
    assert np.isinf(nearest_distance(np.zeros((2, 3)), np.zeros((0, 3)))).all()
