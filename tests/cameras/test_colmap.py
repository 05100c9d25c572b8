"""COLMAP models: COLMAP itself reads what we write, and writes what we read."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stages.base.errors import SplatError
from stages.cameras.camera_file import CameraFile
from stages.cameras.colmap import (
    files,
    locate,
    read,
    read_model,
    read_points,
    write_model,
)
from tests.cameras.models import Model, example


def test_colmap_reads_what_was_written(tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    model = example()
    model.write(tmp_path / "0")
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
        assert (point.xyz == model.cloud.points[number - 1]).all()
        assert (point.color == model.cloud.colours[number - 1]).all()
    # Tracks and observations name each other rightly: COLMAP finds no reprojection error.
    read.update_point_3d_errors()
    assert read.compute_mean_reprojection_error() < 1e-9
    assert read.compute_num_observations() == len(model.observations.points)


def test_equal_models_give_equal_bytes(tmp_path: Path) -> None:
    example().write(tmp_path / "a")
    example().write(tmp_path / "b")
    for name in ("cameras.bin", "images.bin", "points3D.bin"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


def test_photographs_that_a_model_lists_as_test_are_held_out(tmp_path: Path) -> None:
    model = example()
    model.write(tmp_path)
    assert {view.role for view in read(tmp_path).views} == {""}
    (tmp_path / "test.txt").write_text(f"{model.names[3]}\r\n\nnot_registered.jpg\n")
    assert tmp_path / "test.txt" in files(tmp_path)
    roles = {view.name: view.role for view in read(tmp_path).views}
    assert roles == {name: "test" if name == model.names[3] else "train" for name in model.names}


def test_a_model_without_points_is_still_a_model(tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    write_model(tmp_path, example().names, example().cameras)
    assert pycolmap.Reconstruction(tmp_path).num_reg_images() == 5


def assert_same(found: Model, wanted: Model) -> None:
    assert found.names == wanted.names
    for ours, theirs in zip(found.cameras, wanted.cameras, strict=True):
        assert replace(ours, world_to_camera=theirs.world_to_camera) == theirs
        np.testing.assert_allclose(ours.world_to_camera, theirs.world_to_camera, atol=1e-14)
    for name in ("points", "colours", "tracks"):
        np.testing.assert_array_equal(getattr(found.cloud, name), getattr(wanted.cloud, name))
    for name in ("points", "views", "px"):
        np.testing.assert_array_equal(
            getattr(found.observations, name), getattr(wanted.observations, name)
        )


def read_back(folder: Path) -> tuple[CameraFile, Model]:
    found, cloud, observations = read_model(folder)
    names = tuple(view.name for view in found.views)
    return found, Model(names, tuple(view.camera for view in found.views), cloud, observations)


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    example().write(tmp_path / "sparse" / "0")
    folder = locate(tmp_path)
    assert folder == tmp_path / "sparse" / "0"
    cameras, model = read_back(folder)
    assert_same(model, example())
    np.testing.assert_array_equal(model.cloud.errors_px, example().cloud.errors_px)
    assert cameras.distorted == 0


@pytest.mark.parametrize("text", [False, True])
def test_what_colmap_writes_is_read(tmp_path: Path, text: bool) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    example().write(tmp_path / "ours")
    theirs = tmp_path / "theirs"
    theirs.mkdir()
    loaded = pycolmap.Reconstruction(tmp_path / "ours")
    (loaded.write_text if text else loaded.write_binary)(str(theirs))
    _, model = read_back(theirs)
    order = np.argsort(model.names)
    wanted = np.argsort(example().names)
    assert [model.names[i] for i in order] == [example().names[i] for i in wanted]
    for i, j in zip(order, wanted, strict=True):
        ours, known = model.cameras[i], example().cameras[j]
        assert (ours.width, ours.height, ours.fx, ours.cy) == (640, 480, known.fx, 240.0)
        np.testing.assert_allclose(ours.world_to_camera, known.world_to_camera, atol=1e-13)
    assert len(model.cloud.points) == 30
    assert len(model.observations.points) == len(example().observations.points)


@pytest.mark.parametrize(
    ("model", "params", "lens", "distorted"),
    [
        ("SIMPLE_PINHOLE", "500 320 240", (500, 500, 320, 240), 0),
        ("PINHOLE", "500 510 320 240", (500, 510, 320, 240), 0),
        ("SIMPLE_RADIAL", "500 320 240 0.1", (500, 500, 320, 240), 1),
        ("SIMPLE_RADIAL", "500 320 240 0", (500, 500, 320, 240), 0),
        ("RADIAL", "500 320 240 0 0.1", (500, 500, 320, 240), 1),
        ("OPENCV", "500 510 320 240 0 0 0 0.1", (500, 510, 320, 240), 1),
        ("FULL_OPENCV", "500 510 320 240 0 0 0 0 0 0 0 1", (500, 510, 320, 240), 1),
    ],
)
def test_lenses_are_read_and_distortion_is_counted(
    tmp_path: Path, model: str, params: str, lens: tuple[float, ...], distorted: int
) -> None:
    (tmp_path / "cameras.txt").write_text(f"# a comment\n7 {model} 640 480 {params}\n")
    (tmp_path / "images.txt").write_text("3 1 0 0 0 0.5 0 2 7 my photo.jpg\n\n")
    found = read(tmp_path)
    (view,) = found.views
    camera = view.camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == lens
    assert view.name == "my photo.jpg"
    np.testing.assert_array_equal(camera.centre, [-0.5, 0, -2])
    assert found.distorted == distorted


@pytest.mark.parametrize("points", [None, "", "# 3D point list with one line of data per point\n"])
def test_a_text_model_of_known_cameras_needs_no_points(tmp_path: Path, points: str | None) -> None:
    (tmp_path / "cameras.txt").write_text("1 PINHOLE 64 48 50 50 32 24\n")
    (tmp_path / "images.txt").write_text("1 1 0 0 0 0 0 0 1 a.jpg\n\n")
    if points is not None:
        (tmp_path / "points3D.txt").write_text(points)
    found = read_points(tmp_path)
    assert found is None or not len(found.points)


def damaged(folder: Path, name: str, change) -> None:
    example().write(folder)
    path = folder / f"{name}.bin"
    path.write_bytes(change(path.read_bytes()))


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
@pytest.mark.parametrize(
    "change",
    [
        lambda b: b"",
        lambda b: b[: len(b) // 2],
        lambda b: b[:-1],
        lambda b: (1 << 60).to_bytes(8, "little") + b[8:],
        lambda b: b"\xff" * len(b),
        lambda b: b[:8] + b"\xff" * (len(b) - 8),
    ],
    ids=["empty", "half", "one byte less", "huge count", "ones", "ones after the count"],
)
def test_damaged_models_are_refused_quickly(tmp_path: Path, name: str, change) -> None:
    damaged(tmp_path, name, change)
    with pytest.raises(SplatError) as caught:
        read_model(tmp_path)
    assert caught.value.code == "cameras-unreadable"
    assert name in caught.value.given


@pytest.mark.parametrize(
    ("cameras", "images", "said"),
    [
        ("1 EQUIRECTANGULAR 64 48 64 48", "1 1 0 0 0 0 0 0 1 a", "EQUIRECTANGULAR"),
        ("1 SIMPLE_RADIAL 64 48 50 32 24 nan", "1 1 0 0 0 0 0 0 1 a", "not a number"),
        ("1 PINHOLE 64 48 50 50 32", "1 1 0 0 0 0 0 0 1 a", "PINHOLE"),
        ("1 PINHOLE 64 48 50 50 32 24", "1 1 0 0 0 0 0 0 2 a", "no camera 2"),
        ("1 PINHOLE 64 48 50 50 32 24", "1 0 0 0 0 0 0 0 1 a", "direction"),
        ("1 PINHOLE 64 48 50 50 32 24", "1 1 0 0 0 nan 0 0 1 a", "position"),
        ("1 PINHOLE 64 48 -50 50 32 24", "1 1 0 0 0 0 0 0 1 a", "focal"),
        ("1 PINHOLE 0 48 50 50 32 24", "1 1 0 0 0 0 0 0 1 a", "size"),
        ("1 PINHOLE 9999999999 48 50 50 32 24", "1 1 0 0 0 0 0 0 1 a", "size"),
        ("1 PINHOLE 64 48 50 50 32 24", "", "empty"),
        ("1 PINHOLE 64 48 50 50 32 24", "# nothing", "no camera"),
        ("1 PINHOLE 64 48 50 50 32 24", "1 1 0 0 0 0 0", "lacks a part"),
    ],
)
def test_what_is_no_camera_is_refused(tmp_path: Path, cameras: str, images: str, said: str) -> None:
    (tmp_path / "cameras.txt").write_text(cameras + "\n")
    (tmp_path / "images.txt").write_text(images and images + "\n\n")
    with pytest.raises(SplatError) as caught:
        read(tmp_path)
    assert said in caught.value.given
