"""transforms.json against numbers worked out by hand."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from plyfile import PlyData

from stages.base.errors import SplatError
from stages.cameras.camera_formats import read_cameras, read_points
from stages.cameras.nerfstudio import write
from stages.scene import Camera, View, look_at
from tests.sfm.synthetic import random_rotation


def camera(matrix: np.ndarray, fx: float = 500.0) -> Camera:
    return Camera(640, 480, fx, 510.0, 320.5, 240.0, matrix)


def views(count: int = 5) -> tuple[View, ...]:
    made = []
    for i in range(count):
        matrix = np.eye(4)
        matrix[:3, :3] = random_rotation(i)
        matrix[:3, 3] = np.random.default_rng(i).normal(size=3) * 10
        made.append(View(f"ü {i}.jpg", f"day 1/ü {i}.jpg", camera(matrix, 500.0 + i)))
    return tuple(made)


def written(folder: Path, *seen: View) -> dict[str, Any]:
    write(folder / "transforms.json", seen, folder / "images")
    return json.loads((folder / "transforms.json").read_text(encoding="utf-8"))


def test_a_camera_two_steps_back_looks_along_nerfstudios_y(tmp_path: Path) -> None:
    """By hand: our camera at (1, -3, -2), level, looks along +z; up is -y. In nerfstudio's world
    (x, z, -y) it is at (1, -2, 3), its right is +x, its up is +z and it looks along +y: its third
    column, which points backward, is -y."""
    eye = np.array([1.0, -3.0, -2.0])
    level = View("a.jpg", "a.jpg", camera(look_at(eye, np.array([1.0, -3.0, 0.0]))))
    data = written(tmp_path, level)
    pose = [[1, 0, 0, 1], [0, 0, -1, -2], [0, 1, 0, 3], [0, 0, 0, 1]]
    assert data["frames"][0]["transform_matrix"] == pose
    assert data["applied_transform"] == [[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]]
    assert data["frames"][0]["file_path"] == "images/a.jpg"
    assert (data["w"], data["h"], data["fl_x"], data["fl_y"]) == (640, 480, 500, 510)
    assert (data["cx"], data["cy"], data["camera_model"]) == (320.5, 240, "PINHOLE")
    assert "fl_x" not in data["frames"][0]


def test_a_pixel_is_the_same_ray_in_both_conventions(tmp_path: Path) -> None:
    """A point of the world, projected as nerfstudio does: y up, looking along -z."""
    point = np.array([0.3, -0.2, 0.4])
    for view, frame in zip(views(), written(tmp_path, *views())["frames"], strict=True):
        ours = view.camera.world_to_camera @ [*point, 1]
        saved = np.array([point[0], point[2], -point[1], 1])
        theirs = np.linalg.inv(frame["transform_matrix"]) @ saved
        x = frame["cx"] + frame["fl_x"] * theirs[0] / -theirs[2]
        y = frame["cy"] - frame["fl_y"] * theirs[1] / -theirs[2]
        c = view.camera
        wanted = c.cx + c.fx * ours[0] / ours[2], c.cy + c.fy * ours[1] / ours[2]
        np.testing.assert_allclose((x, y), wanted, rtol=1e-9)


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    written(tmp_path, *views())
    found = read_cameras(tmp_path / "transforms.json")
    for ours, known in zip(found.views, views(), strict=True):
        assert ours.image == f"images/{known.image}"
        theirs = known.camera.world_to_camera
        assert replace(ours.camera, world_to_camera=theirs) == known.camera
        np.testing.assert_allclose(ours.camera.world_to_camera, theirs, rtol=0, atol=1e-13)
    assert (found.folder, found.distorted) == (tmp_path, 0)


def test_pictures_and_points_are_named_from_the_files_folder(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    points, colours = np.array([[1.0, 2.0, 3.0]]), np.array([[10, 20, 30]], np.uint8)
    target = tmp_path / "out" / "transforms.json"
    write(target, views(1), tmp_path / "run" / "images", points, colours)
    data = json.loads(target.read_text(encoding="utf-8"))
    assert data["frames"][0]["file_path"] == "../run/images/day 1/ü 0.jpg"
    (row,) = PlyData.read(str(tmp_path / "out" / data["ply_file_path"]))["vertex"].data
    assert row.tolist() == (1, 3, -2, 10, 20, 30)


def plain(**more: Any) -> dict[str, Any]:
    frame = {"file_path": "a.png", "transform_matrix": np.eye(4).tolist()}
    return {"w": 640, "h": 480, "fl_x": 500, "frames": [frame], **more}


def read_back(folder: Path, data: object):
    path = folder / "t.json"
    path.write_text(data if isinstance(data, str) else json.dumps(data))
    return read_cameras(path)


def test_a_file_without_a_turn_is_in_its_own_world(tmp_path: Path) -> None:
    """By hand: OpenGL's camera at the origin looks along -z with +y up."""
    (view,) = read_back(tmp_path, plain()).views
    np.testing.assert_array_equal(view.camera.forward, [0, 0, -1])
    np.testing.assert_array_equal(view.camera.world_to_camera[1, :3], [0, -1, 0])
    assert (view.camera.fy, view.camera.cx, view.camera.cy) == (500, 320, 240)


def test_scale_and_turn_are_undone(tmp_path: Path) -> None:
    """By hand: saved = 2 (turn p + shift) with the camera at saved (2, 4, 6), so turn p + shift =
    (1, 2, 3), turn p = (1, 2, 2), and p = (2, -1, 2) for a turn that takes (x, y, z) to
    (-y, x, z)."""
    turn = [[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 1]]
    data = plain(applied_transform=turn, applied_scale=2.0)
    for row, value in zip(data["frames"][0]["transform_matrix"], (2, 4, 6), strict=False):
        row[3] = value
    (view,) = read_back(tmp_path, data).views
    np.testing.assert_allclose(view.camera.centre, [2, -1, 2], atol=1e-14)


def test_instant_ngps_angle_is_a_focal_length(tmp_path: Path) -> None:
    data = plain(camera_angle_x=np.pi / 2)
    del data["fl_x"]
    (view,) = read_back(tmp_path, data).views
    assert view.camera.fx == pytest.approx(320)


def test_a_frames_own_lens_comes_first(tmp_path: Path) -> None:
    data = plain(k1=0.0)
    data["frames"] = [data["frames"][0] | {"fl_x": 77, "k1": 0.1}, data["frames"][0]]
    found = read_back(tmp_path, data)
    assert [view.camera.fx for view in found.views] == [77, 500]
    assert found.distorted == 1


@pytest.mark.parametrize("start", ["..", "a/../..", ""])
def test_points_outside_the_files_folder_are_refused(tmp_path: Path, start: str) -> None:
    inner, other = tmp_path / "inner", tmp_path / "other"
    inner.mkdir()
    other.mkdir()
    write(other / "all.json", views(1), other, np.ones((1, 3)), np.zeros((1, 3), np.uint8))
    where = f"{start or tmp_path}/other/all.ply"
    (inner / "t.json").write_text(json.dumps(plain(ply_file_path=where)))
    with pytest.raises(SplatError, match="which is outside") as caught:
        read_points(inner / "t.json")
    assert (caught.value.code, where[:80] in caught.value.given) == ("cameras-unreadable", True)


def test_a_picture_outside_the_files_folder_is_not_opened(tmp_path: Path) -> None:
    (tmp_path / "inner").mkdir()
    Image.new("RGB", (640, 480)).save(tmp_path / "a.png")
    data = without("w")
    data["frames"][0]["file_path"] = "../a.png"
    with pytest.raises(SplatError, match="which is outside"):
        read_back(tmp_path / "inner", data)


def turned(by: object) -> dict[str, Any]:
    data = plain()
    data["frames"][0]["transform_matrix"] = by
    return data


def named(name: str) -> dict[str, Any]:
    data = plain()
    data["frames"][0]["file_path"] = name
    return data


def without(key: str) -> dict[str, Any]:
    data = plain()
    (data if key in data else data["frames"][0]).pop(key)
    return data


@pytest.mark.parametrize(
    ("data", "said"),
    [
        ("", "empty"),
        ("{", "damaged"),
        ("[" * 100_000, "damaged"),
        ("[]", "no reconstruction"),
        ('{"frames": {}}', "frames"),
        (plain(frames=[]), "no camera"),
        (plain(frames=[3]), "object"),
        (without("w"), "no w and h"),
        (without("fl_x"), "no fl_x"),
        (without("transform_matrix"), "no transform_matrix"),
        (without("file_path"), "no file_path"),
        (plain(w=float("nan")), "not a number"),
        (plain(w=10**400), "damaged"),
        (plain(w=10**9), "size"),
        (plain(w=0), "size"),
        (plain(fl_x=-1), "focal"),
        (plain(fl_x="wide"), "damaged"),
        (plain(fl_x=None), "damaged"),
        (plain(camera_model="EQUIRECTANGULAR"), "EQUIRECTANGULAR"),
        (plain(k1="much"), "damaged"),
        (plain(k1=float("nan")), "not a number"),
        (plain(camera_angle_x=0) | {"fl_x": 0}, "focal"),
        (plain(applied_scale=0), "applied_scale"),
        (plain(applied_transform=[[2, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]), "applied_transform"),
        (plain(applied_transform=[1, 2, 3]), "applied_transform"),
        (turned(np.diag([2.0, 1, 1, 1]).tolist()), "rotation"),
        (turned(np.diag([-1.0, 1, 1, 1]).tolist()), "rotation"),
        (turned(np.full((4, 4), np.nan).tolist()), "position"),
        (turned(np.full((4, 4), 1e300).tolist()), "position"),
        (turned([[1, 2], [3]]), "damaged"),
        (turned("up"), "damaged"),
        (turned([]), "damaged"),
        (named("\ud800.png"), "name"),
        (named("a\0.png"), "name"),
    ],
)
def test_what_is_no_camera_is_refused(tmp_path: Path, data: object, said: str) -> None:
    with pytest.raises(SplatError) as caught:
        read_back(tmp_path, data)
    assert caught.value.code == "cameras-unreadable"
    assert said in caught.value.given


def test_a_matrix_in_few_decimals_is_still_a_rotation(tmp_path: Path) -> None:
    written(tmp_path, *views())
    data = json.loads((tmp_path / "transforms.json").read_text(encoding="utf-8"))
    for frame in data["frames"]:
        frame["transform_matrix"] = np.round(frame["transform_matrix"], 4).tolist()
    for view in read_back(tmp_path, data).views:
        rotation = view.camera.world_to_camera[:3, :3]
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)


def test_what_is_neither_file_nor_model_is_said(tmp_path: Path) -> None:
    for path in (tmp_path, tmp_path / "nothing", tmp_path / "none.json"):
        with pytest.raises(SplatError):
            read_cameras(path)
