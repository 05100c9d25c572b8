"""`splat cameras`: from a run, from nerfstudio and from COLMAP, to either."""

from __future__ import annotations

import errno
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from plyfile import PlyData, PlyElement

from stages.cameras import colmap
from stages.cameras.camera_formats import read_cameras
from stages.cameras.colmap import read_model
from stages.scene import look_at
from tests.cameras.models import example


def poses(path: Path) -> dict[str, np.ndarray]:
    views = read_cameras(path).views
    return {view.name.rpartition("/")[2]: view.camera.world_to_camera for view in views}


def project(folder: Path) -> Path:
    """A COLMAP project as COLMAP lays it out."""
    example().write(folder / "sparse" / "0")
    for name in example().names:
        picture = folder / "images" / name
        picture.parent.mkdir(parents=True, exist_ok=True)
        picture.write_bytes(b"")
    return folder


def test_colmap_to_nerfstudio_and_back(splat, tmp_path: Path) -> None:
    source = project(tmp_path / "project")
    assert splat("cameras", "project", "transforms.json").exit_code == 0
    data = json.loads(Path("transforms.json").read_text(encoding="utf-8"))
    assert data["frames"][0]["file_path"] == "project/images/a.jpg"
    assert Path(data["ply_file_path"]).exists()
    result = splat("cameras", "transforms.json", "again")
    assert result.exit_code == 0, result.output
    assert "5 cameras" in result.stderr
    before, after = poses(source), poses(Path("again"))
    assert set(before) == set(after)
    for name, pose in before.items():
        np.testing.assert_allclose(after[name], pose, atol=1e-12)


def z_up(applied: dict[str, Any]) -> None:
    """in.json: four cameras around the origin, z up, with points in the plane z = 0 to 1."""
    points = np.random.default_rng(0).uniform(0, 1, (50, 3)).astype(np.float32)
    rows = np.empty(50, [(axis, "<f4") for axis in "xyz"])
    for axis, values in zip("xyz", points.T, strict=True):
        rows[axis] = values
    PlyData([PlyElement.describe(rows, "vertex")]).write("p.ply")
    frames = []
    for number, eye in enumerate(np.array([[3.0, 0, 1], [0, 3, 1], [-3, 0, 1], [0, -3, 1]])):
        pose = np.linalg.inv(look_at(eye, np.zeros(3), np.array([0.0, 0, 1])))
        pose[:3, 1:3] *= -1  # OpenGL's axes
        frames.append({"file_path": f"{number}.png", "transform_matrix": pose.tolist()})
    data = {"w": 64, "h": 48, "fl_x": 50.0, "ply_file_path": "p.ply", "frames": frames}
    Path("in.json").write_text(json.dumps(data | applied))


@pytest.mark.parametrize("applied", [{}, {"applied_transform": np.eye(4)[:3].tolist()}])
def test_a_z_up_world_is_written_z_up_for_nerfstudio_and_y_down_for_colmap(
    splat, applied: dict[str, Any]
) -> None:
    z_up(applied)
    assert splat("cameras", "in.json", "out.json").exit_code == 0
    before, after = (json.loads(Path(name).read_text()) for name in ("in.json", "out.json"))
    for one, other in zip(before["frames"], after["frames"], strict=True):
        np.testing.assert_allclose(other["transform_matrix"], one["transform_matrix"], atol=1e-14)
    given, written = (PlyData.read(name)["vertex"].data for name in ("p.ply", "out_points.ply"))
    for axis in "xyz":
        np.testing.assert_array_equal(written[axis], given[axis])

    result = splat("cameras", "in.json", "sparse", "--json")
    assert json.loads(result.stdout)["points"] == 50
    found, cloud, _ = read_model(Path("sparse"))
    for view, frame in zip(found.views, before["frames"], strict=True):
        x, y, z = np.array(frame["transform_matrix"])[:3, 3]
        np.testing.assert_allclose(view.camera.centre, [x, -z, y], atol=1e-12)
        assert view.camera.world_to_camera[1, 1] > 0.9  # the camera's down is the world's y
    np.testing.assert_array_equal(cloud.points[:, 1], -given["z"].astype(float))
    np.testing.assert_array_equal(cloud.points[:, 2], given["y"].astype(float))


def test_a_benchmark_of_blender_is_z_up(splat, tmp_path: Path) -> None:
    z_up({})
    Path("scene").mkdir()
    Path("p.ply").rename("scene/p.ply")
    Path("in.json").rename("scene/transforms_train.json")
    assert splat("cameras", "scene", "sparse").exit_code == 0
    found, cloud, _ = read_model(Path("sparse"))
    assert len(cloud.points) == 50
    np.testing.assert_allclose([view.camera.centre[1] for view in found.views], -1, atol=1e-12)


def test_splats_of_the_same_name_stay(splat, tmp_path: Path) -> None:
    project(tmp_path / "project")
    Path("scene.ply").write_text("splats")
    assert splat("cameras", "project", "scene.json").exit_code == 0
    assert Path("scene.ply").read_text() == "splats"
    points = json.loads(Path("scene.json").read_text(encoding="utf-8"))["ply_file_path"]
    assert len(PlyData.read(points)["vertex"].data) == 30


@pytest.mark.parametrize("target", ["cameras.json", "project/sparse/0"])
def test_cameras_are_not_written_onto_their_source(splat, tmp_path: Path, target: str) -> None:
    project(tmp_path / "project")
    splat("cameras", "project", "cameras.json")
    before = {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()}
    result = splat("cameras", target, target)
    assert result.exit_code == 2
    assert "target-is-source" in result.stderr
    assert {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()} == before


def test_points_are_not_written_onto_those_that_are_read(splat, tmp_path: Path) -> None:
    """Here they would be turned, and no longer fit the cameras that are read."""
    project(tmp_path / "project")
    splat("cameras", "project", "first.json")
    data = json.loads(Path("first.json").read_text())
    data["applied_transform"] = np.eye(4)[[1, 2, 0]].tolist()
    Path("first.json").write_text(json.dumps(data))
    Path("first.json").rename("second.json")
    before = Path("first_points.ply").read_bytes()
    result = splat("cameras", "second.json", "first.json")
    assert result.exit_code == 2
    assert "target-is-source" in result.stderr
    assert Path("first_points.ply").read_bytes() == before


def test_colmap_keeps_its_points(splat, tmp_path: Path) -> None:
    project(tmp_path / "project")
    result = splat("cameras", "project", "copy", "--json")
    told = json.loads(result.stdout)
    assert (told["cameras"], told["points"], told["pictures_found"]) == (5, 30, True)
    _, cloud, observations = read_model(Path("copy"))
    np.testing.assert_array_equal(cloud.points, example().cloud.points)
    np.testing.assert_array_equal(observations.px, example().observations.px)


def test_a_full_disk_leaves_no_part_of_a_model(
    splat, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    project(tmp_path / "project")
    monkeypatch.setattr(colmap, "_write_points", full)
    result = splat("cameras", "project", "copy")
    assert result.exit_code == 6
    assert "disk-full" in result.stderr
    assert not list(Path("copy").iterdir())


def test_a_run_gives_what_its_sfm_found(splat, pretend, tmp_path: Path) -> None:
    def sfm(inputs, settings, folder, report) -> None:
        project(folder / "colmap")

    pretend["sfm"] = sfm
    early = splat("cameras", "run", "t.json")
    assert early.exit_code == 2
    splat("ingest", "photos")
    early = splat("cameras", "run", "t.json")
    assert early.exit_code == 2
    assert "splat process" in early.stderr
    splat("sfm")
    result = splat("cameras", "run", "t.json")
    assert result.exit_code == 0, result.output
    data = json.loads(Path("t.json").read_text(encoding="utf-8"))
    assert data["frames"][1]["file_path"] == "run/2-sfm/colmap/images/day 1/b.jpg"


@pytest.mark.parametrize("out", ["a.txt", "photos/a.jpg"])
def test_unknown_targets_name_the_known(splat, tmp_path: Path, out: str) -> None:
    project(tmp_path / "project")
    result = splat("cameras", "project", out)
    assert result.exit_code == 2
    assert ".json" in result.stderr
    assert not Path("a.txt").exists()


def test_lenses_that_distort_are_refused(splat, tmp_path: Path) -> None:
    (tmp_path / "cameras.txt").write_text("1 SIMPLE_RADIAL 64 48 50 32 24 0.1\n")
    (tmp_path / "images.txt").write_text("1 1 0 0 0 0 0 0 1 a.jpg\n\n")
    (tmp_path / "points3D.txt").write_text("# none\n")
    result = splat("cameras", ".", "t.json")
    assert result.exit_code == 3
    assert "distort" in result.stderr
    assert not Path("t.json").exists()


def test_missing_pictures_are_reported(splat, tmp_path: Path) -> None:
    example().write(tmp_path / "model")
    result = splat("cameras", "model", "t.json")
    assert result.exit_code == 0
    assert "not in" in result.stderr
