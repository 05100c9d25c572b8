"""The COLMAP model is read back by COLMAP itself and says the same."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stages.scene import Camera
from stages.structure.colmap_files import (
    ColmapModel,
    rotation_to_quaternion,
    write_colmap_model,
)
from tests.structure.synthetic import orbit_model, random_rotation


def example() -> ColmapModel:
    """Five views, two of them with another focal length; pinhole observations."""
    model = orbit_model(views=5, points=30)
    focals = (500.0, 500.0, 510.0, 510.0, 500.0)
    cameras = tuple(
        Camera(640, 480, focal, focal, 320.0, 240.0, pose)
        for focal, pose in zip(focals, model.world_to_camera, strict=True)
    )
    keep = (model.observed_points + model.observing_views) % 4 != 0
    points, views = model.observed_points[keep], model.observing_views[keep]
    poses = model.world_to_camera[views]
    xyz = np.einsum("oij,oj->oi", poses[:, :3, :3], model.points[points]) + poses[:, :3, 3]
    px = np.array(focals)[views, None] * xyz[:, :2] / xyz[:, 2:] + (320.0, 240.0)
    return ColmapModel(
        names=("a.jpg", "day 1/b.jpg", "ü.jpg", "d.jpg", "e.jpg"),
        cameras=cameras,
        points=model.points,
        colours=model.colours,
        errors_px=np.linspace(0, 1, 30),
        observed_points=points,
        observing_views=views,
        observed_px=px,
    )


def test_colmap_reads_what_was_written(tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    model = example()
    write_colmap_model(tmp_path / "0", model)
    read = pycolmap.Reconstruction(tmp_path / "0")
    assert sorted(path.name for path in (tmp_path / "0").iterdir()) == [
        "cameras.bin",
        "images.bin",
        "points3D.bin",
    ]
    assert (read.num_cameras(), read.num_reg_images(), read.num_points3D()) == (2, 5, 30)
    for i, camera in enumerate(model.cameras):
        image = read.images[i + 1]
        assert image.name == model.names[i]
        assert np.allclose(image.cam_from_world().matrix(), camera.world_to_camera[:3], atol=1e-12)
        assert read.cameras[image.camera_id].focal_length_x == camera.fx
    for number, point in read.points3D.items():
        assert (point.xyz == model.points[number - 1]).all()
        assert (point.color == model.colours[number - 1]).all()
    # Tracks and observations name each other rightly: COLMAP finds no reprojection error.
    read.update_point_3d_errors()
    assert read.compute_mean_reprojection_error() < 1e-9
    assert read.compute_num_observations() == len(model.observed_points)


def test_equal_models_give_equal_bytes(tmp_path: Path) -> None:
    write_colmap_model(tmp_path / "a", example())
    write_colmap_model(tmp_path / "b", example())
    for name in ("cameras.bin", "images.bin", "points3D.bin"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


def test_a_model_without_points_is_still_a_model(tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    none = np.zeros(0, np.int32)
    model = replace(
        example(),
        points=np.zeros((0, 3)),
        colours=np.zeros((0, 3), np.uint8),
        errors_px=np.zeros(0),
        observed_points=none,
        observing_views=none,
        observed_px=np.zeros((0, 2)),
    )
    write_colmap_model(tmp_path, model)
    assert pycolmap.Reconstruction(tmp_path).num_reg_images() == 5


@given(st.integers(0, 1000))
def test_quaternions_are_those_of_the_rotation(seed: int) -> None:
    rotation = random_rotation(seed)
    w, x, y, z = rotation_to_quaternion(rotation)
    again = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    assert np.allclose(again, rotation, atol=1e-12)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_half_turns_have_quaternions_too(axis: int) -> None:
    rotation = -np.eye(3)
    rotation[axis, axis] = 1.0
    quaternion = rotation_to_quaternion(rotation)
    assert abs(quaternion[axis + 1]) == pytest.approx(1.0)
