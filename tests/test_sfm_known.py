"""The sfm stage with cameras that are known: the sample capture, whose poses are."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from stages import sfm
from stages.base.errors import SplatError
from stages.base.stage import Report
from stages.scene import Reconstruction, split_held_out
from stages.scene.rotations import quaternions_of
from tests.structure import bad_captures
from tests.structure.truth import TRUTH, centres, similarity

POSES = {
    photo["name"]: np.array(photo["world_to_camera"])
    for photo in json.loads(TRUTH.read_text())["photos"]
}


def model(folder: Path, change: Callable[[np.ndarray], np.ndarray], count: int) -> Path:
    """A COLMAP model without points, as text."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "cameras.txt").write_text("1 SIMPLE_RADIAL 640 480 600 320 240 -0.045\n")
    lines = []
    for number, (name, pose) in enumerate(list(POSES.items())[:count], 1):
        pose = change(pose)
        words = [number, *quaternions_of(pose[:3, :3]), *pose[:3, 3], 1, name]
        lines.append(" ".join(map(str, words)) + "\n\n")
    (folder / "images.txt").write_text("".join(lines))
    return folder


def reconstructed(
    folder: Path, cameras: Path, count: int = 5, **more: object
) -> tuple[Reconstruction, Report]:
    settings = sfm.SfmSettings(max_features=1000, cameras=cameras, **more)  # type: ignore[arg-type]
    report = Report()
    inputs = {"ingest": bad_captures.sample(count)}
    return sfm.run(inputs, settings, folder, report), report


def test_given_cameras_are_kept_and_points_are_triangulated(tmp_path: Path) -> None:
    cameras = model(tmp_path / "cameras", lambda pose: pose, 5)
    found, report = reconstructed(tmp_path / "sfm", cameras)
    wanted = np.array([POSES[view.name] for view in found.views])
    have = np.array([view.camera.world_to_camera for view in found.views])
    turn, scale, shift = similarity(centres(have), centres(wanted))
    assert scale == pytest.approx(1.0, abs=1e-6)
    np.testing.assert_allclose(centres(have) @ turn.T + shift, centres(wanted), atol=1e-6)
    back = np.array(report.metrics["file_from_world"])
    np.testing.assert_allclose(have @ np.linalg.inv(back), wanted, atol=1e-6)
    assert found.levelled
    assert len(found.points) > 100
    assert report.metrics["points_from"] == "matches"
    assert report.metrics["matches_that_fit"] > 0.9
    assert report.metrics["mean_reprojection_error_px"] < 1.0
    views = sfm.load(tmp_path / "sfm").views
    assert [view.name for view in views] == [view.name for view in found.views]
    assert not (tmp_path / "sfm" / "work").exists()


def test_opengl_axes_are_refused_by_their_name(tmp_path: Path) -> None:
    turn = np.diag([1.0, -1.0, -1.0, 1.0])
    cameras = model(tmp_path / "cameras", lambda pose: turn @ pose, 5)
    with pytest.raises(SplatError) as caught:
        reconstructed(tmp_path / "sfm", cameras)
    assert caught.value.code == "cameras-do-not-fit"
    assert "y and z of each camera are turned round" in caught.value.hint


def test_a_splits_test_photographs_judge_and_lend_no_points(tmp_path: Path) -> None:
    frames = []
    flip = np.diag([1.0, -1.0, -1.0, 1.0])
    for name in list(POSES)[:6]:
        matrix = np.linalg.inv(flip @ POSES[name])
        frames.append({"file_path": name, "transform_matrix": matrix.tolist()})
    data = {
        "w": 640,
        "h": 480,
        "fl_x": 600,
        "k1": -0.045,
        "frames": frames,
        "train_filenames": [frame["file_path"] for frame in frames[:4]],
        "test_filenames": [frames[4]["file_path"]],
    }
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps(data))
    found, _ = reconstructed(tmp_path / "sfm", path, 6, split=True)
    names = [Path(frame["file_path"]).name for frame in frames]
    training, judges = split_held_out(sfm.load(tmp_path / "sfm").views)
    assert [view.name for view in training] == names[:4]
    assert [view.name for view in judges] == names[4:5]
    assert found.tracks.max() <= 4
    without, _ = reconstructed(tmp_path / "all", path, 6)
    assert {view.role for view in without.views} == {""}
    assert len(without.views) == 6


def test_photographs_without_cameras_are_named(tmp_path: Path) -> None:
    cameras = model(tmp_path / "cameras", lambda pose: pose, 4)
    with pytest.raises(SplatError) as caught:
        reconstructed(tmp_path / "sfm", cameras)
    assert caught.value.code == "cameras-missing"
    assert list(POSES)[4] in caught.value.given
