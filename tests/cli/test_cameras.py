"""`splat cameras`: from a run, from nerfstudio and from COLMAP, to either."""

from __future__ import annotations

import errno
import json
from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData

from stages.cameras import colmap
from stages.cameras.camera_formats import read_cameras
from stages.cameras.colmap import read_model
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
