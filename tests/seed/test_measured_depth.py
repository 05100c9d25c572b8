"""Measured depth: points lie on the surface that was measured, in world units."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stages.base.stage import Report
from stages.ingest.write import write_depth
from stages.scene import Camera, Reconstruction, View
from stages.seed.measured_depth import measured_points
from stages.sfm.reconstruction_files import (
    FILE_NAME,
    load_reconstruction,
    save_reconstruction,
)
from tests.seed.wall_and_plate import HALF, PLATE, WALL, capture

METRES_PER_UNIT = 0.4


def true_depth(view: View) -> np.ndarray:
    """[60, 80] z of the wall and the plate, world units."""
    camera = view.camera.resized(80, 60)
    rows, columns = np.mgrid[:60, :80] + 0.5
    rays = np.stack([(columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy], -1)
    rays = np.concatenate([rays, np.ones_like(rays[..., :1])], -1)
    world = rays @ camera.world_to_camera[:3, :3]
    plate = (PLATE - camera.centre[2]) / world[..., 2]
    wall = (WALL - camera.centre[2]) / world[..., 2]
    at = camera.centre + world * plate[..., None]
    return np.asarray(np.where(np.abs(at[..., :2]).max(-1) < HALF, plate, wall), np.float32)


@pytest.fixture
def plain(tmp_path: Path) -> tuple[Path, tuple[View, ...], np.ndarray]:
    """Photographs without texture, with depth maps in metres."""
    views, points = capture(tmp_path, plain=True)
    views = tuple(replace(view, depth=f"{view.name}.npy") for view in views)
    for view in views:
        write_depth(tmp_path / view.depth, np.float32(METRES_PER_UNIT) * true_depth(view))
    return tmp_path, views, points


def found_in(plain, **changes: np.ndarray) -> tuple[np.ndarray, Report]:
    folder, views, points = plain
    for name, depth in changes.items():
        write_depth(folder / f"{name[1:]}.png.npy", depth.astype(np.float32))
    report = Report()
    more, colours = measured_points(folder, views, points, report)
    assert colours.shape == more.shape
    return more, report


def off(points: np.ndarray) -> np.ndarray:
    """[M] relative distance to the nearer of the two surfaces, along z."""
    return np.minimum(np.abs(points[:, 2] / WALL - 1), np.abs(points[:, 2] / PLATE - 1))


def test_points_in_metres_land_on_the_surfaces_of_a_world_of_another_unit(plain) -> None:
    more, report = found_in(plain)
    assert report.metrics["depth_scale"] == pytest.approx(1 / METRES_PER_UNIT, rel=1e-3)
    assert report.metrics["depth_maps"] == 8
    assert not report.warnings
    assert len(more) > 500
    assert off(more).max() < 1e-3
    on_plate = np.abs(more[:, 2] / PLATE - 1) < 0.01
    assert np.abs(more[on_plate, :2]).max() < HALF


def test_noise_is_averaged_over_maps(plain) -> None:
    random = np.random.default_rng(1)
    noisy = {
        f"_{i}": METRES_PER_UNIT * true_depth(view) * random.normal(1, 0.01, (60, 80))
        for i, view in enumerate(plain[1])
    }
    more, _ = found_in(plain, **noisy)
    assert np.sqrt(np.mean(off(more) ** 2)) < 0.007


def test_a_map_that_contradicts_the_photographs_is_left_out_by_name(plain) -> None:
    wrong = METRES_PER_UNIT * true_depth(plain[1][3]) * 1.3
    more, report = found_in(plain, _3=wrong)
    ((code, text),) = report.warnings
    assert code == "seed-depth-contradicts"
    assert "3.png" in text
    assert "4.png" not in text
    assert report.metrics["depth_maps"] == 7
    assert off(more).max() < 1e-3


def test_a_patch_that_others_see_through_gives_no_points(plain) -> None:
    patch = METRES_PER_UNIT * true_depth(plain[1][3])
    patch[5:20, 5:30] *= 0.5  # free space, half as far as the wall
    more, _ = found_in(plain, _3=patch)
    assert off(more).max() < 1e-3


def test_holes_stay_empty_and_no_map_gives_nothing(plain) -> None:
    nothing = np.zeros((60, 80))
    holes = {f"_{i}": nothing for i in range(1, 8)}
    half = METRES_PER_UNIT * true_depth(plain[1][0])
    half[:, 40:] = 0
    more, report = found_in(plain, _0=half, **holes)
    pixels, _ = plain[1][0].camera.resized(80, 60).project(more)
    assert len(more) > 100
    assert pixels[:, 0].max() < 40
    assert not report.warnings
    folder, views, points = plain
    bare = tuple(replace(view, depth="") for view in views)
    assert len(measured_points(folder, bare, points, report)[0]) == 0


def test_a_reconstruction_keeps_its_maps_and_one_without_says_nothing_of_them(
    tmp_path: Path,
) -> None:
    camera, one = Camera(64, 48, 50.0, 50.0, 32.0, 24.0, np.eye(4)), np.ones(1)
    views = tuple(View(f"{i}.jpg", f"{i}.jpg", camera) for i in range(4))
    colours, tracks = np.zeros((1, 3), np.uint8), np.ones(1, np.int32)
    bare = Reconstruction(tmp_path, views, np.ones((1, 3)), colours, one, tracks)
    save_reconstruction(tmp_path, bare)
    assert "depth" not in (tmp_path / FILE_NAME).read_text()
    mapped = replace(views[0], depth="colmap/depth/0.npy")
    save_reconstruction(tmp_path, replace(bare, views=(mapped, *views[1:])))
    loaded = load_reconstruction(tmp_path)
    assert [view.depth for view in loaded.views] == [mapped.depth, "", "", ""]
