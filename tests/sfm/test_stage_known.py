"""The sfm stage with cameras that are known: the sample capture, whose poses are."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from stages.base.errors import SplatError
from stages.base.stage import Report
from stages.scene import Reconstruction, split_held_out
from stages.scene.place import local_positions
from stages.scene.rotations import quaternions_of
from stages.sfm import stage as sfm
from stages.sfm.settings import SfmSettings
from tests.sfm.checks import bad_captures
from tests.sfm.interruptions import damage_database, digests, interrupted
from tests.sfm.truth import TRUTH, centres, off_by, similarity

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
    settings = SfmSettings(max_features=1000, cameras=cameras, **more)  # type: ignore[arg-type]
    report = Report()
    inputs = {"ingest": bad_captures.sample(count)}
    return sfm.run(inputs, settings, folder, report), report


@pytest.mark.slow
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
    assert report.metrics["points_source"] == "triangulation"
    assert report.metrics["epipolar_inlier_ratio"] > 0.9
    assert report.metrics["mean_reprojection_error_px"] < 1.0
    views = sfm.load(tmp_path / "sfm").views
    assert [view.name for view in views] == [view.name for view in found.views]
    assert not (tmp_path / "sfm" / "work").exists()


@pytest.mark.slow
@pytest.mark.parametrize("how", ["empty", "header"])
def test_a_damaged_database_is_made_again(tmp_path: Path, how: str) -> None:
    cameras = model(tmp_path / "cameras", lambda pose: pose, 5)
    reconstructed(tmp_path / "whole", cameras)
    settings = SfmSettings(max_features=1000, cameras=cameras)
    interrupted(bad_captures.sample(5), tmp_path / "sfm", settings)
    work = tmp_path / "sfm" / "work"
    assert (work / "features.done").exists()
    (work / "neighbours.done").touch()  # as after matching
    damage_database(work / "known.db", how)
    reconstructed(tmp_path / "sfm", cameras)
    assert digests(tmp_path / "sfm") == digests(tmp_path / "whole")


@pytest.mark.slow
def test_cameras_in_metres_stay_as_large_as_they_are(tmp_path: Path) -> None:
    cameras = model(tmp_path / "cameras", lambda pose: pose, 5)
    found, report = reconstructed(tmp_path / "sfm", cameras, metres=True)
    wanted = np.array([POSES[view.name] for view in found.views])
    have = np.array([view.camera.world_to_camera for view in found.views])
    assert similarity(centres(have), centres(wanted))[1] == pytest.approx(1.0, abs=1e-6)
    assert (found.units, report.metrics["scale_source"]) == ("metres", "--metres")


@pytest.mark.slow
def test_a_file_that_knows_north_gives_the_world_its_directions(tmp_path: Path) -> None:
    """OpenSfM's world: x east, y north, z up; ours: x east, y down, z north."""
    file_from_truth = np.eye(4)
    file_from_truth[:3, :3] = [[0, 0, 1], [1, 0, 0], [0, 1, 0]]
    shots = {}
    for name, pose in list(POSES.items())[:5]:
        placed = pose @ np.linalg.inv(file_from_truth)
        turn, _ = cv2.Rodrigues(placed[:3, :3])
        shots[name] = {
            "rotation": turn.ravel().tolist(),
            "translation": placed[:3, 3].tolist(),
            "camera": "c",
        }
    lens = {"projection_type": "radial", "width": 640, "height": 480, "focal": 600 / 640}
    data = {
        "cameras": {"c": {**lens, "k1": -0.045, "k2": 0.0}},
        "shots": shots,
        "reference_lla": {"latitude": 48.0, "longitude": 11.0, "altitude": 500.0},
    }
    path = tmp_path / "reconstruction.json"
    path.write_text(json.dumps([data]))
    found, report = reconstructed(tmp_path / "sfm", path)
    assert (found.units, found.levelled) == ("metres", True)
    home = np.array([48.0, 11.0, 500.0])
    for view in found.views:
        assert found.place is not None
        here = local_positions(found.place.beside(view.camera.centre).offset, home)
        rotation, shift = (np.array(shots[view.name][key]) for key in ("rotation", "translation"))
        np.testing.assert_allclose(here, -cv2.Rodrigues(rotation)[0].T @ shift, atol=1e-6)
    stored = sfm.load(tmp_path / "sfm").place
    assert stored is not None
    assert found.place is not None
    assert stored.to_json() == found.place.to_json() == report.metrics["place"]
    wanted = [POSES[view.name][:3, :3] @ file_from_truth[:3, :3].T for view in found.views]
    have = [view.camera.world_to_camera[:3, :3] for view in found.views]
    ours_from_file = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    np.testing.assert_allclose(np.array(have) @ ours_from_file, wanted, atol=1e-9)


def split_file(path: Path) -> list[str]:
    """transforms.json of six photographs: four for training, one held out; their names."""
    frames = []
    flip = np.diag([1.0, -1.0, -1.0, 1.0])
    names = list(POSES)[:6]
    for name in names:
        matrix = np.linalg.inv(flip @ POSES[name])
        frames.append({"file_path": name, "transform_matrix": matrix.tolist()})
    data = {
        "w": 640,
        "h": 480,
        "fl_x": 600,
        "k1": -0.045,
        "frames": frames,
        "train_filenames": names[:4],
        "test_filenames": names[4:5],
    }
    path.write_text(json.dumps(data))
    return names


@pytest.mark.slow
def test_rough_cameras_are_moved_to_where_the_matches_want_them(tmp_path: Path) -> None:
    """Half a degree and a centimetre off at 1.3 m, as of a phone's own tracking."""
    r = np.random.default_rng(1)
    rough = {name: off_by(pose, 0.5, 0.01, r) for name, pose in list(POSES.items())[:8]}
    given = iter(rough.values())
    cameras = model(tmp_path / "cameras", lambda pose: next(given), 8)
    errors = {}
    for name, refine in (("as given", False), ("refined", True)):
        folder = tmp_path / name
        found, report = reconstructed(folder, cameras, 8, refine_cameras=refine)
        wanted = np.array([POSES[view.name] for view in found.views])
        have = np.array([view.camera.world_to_camera for view in found.views])
        turn, scale, shift = similarity(centres(have), centres(wanted))
        off = scale * centres(have) @ turn.T + shift - centres(wanted)
        errors[name] = np.linalg.norm(off, axis=1)
    assert errors["refined"].mean() < 0.2 * errors["as given"].mean()
    assert (
        report.metrics["epipolar_inlier_ratio"]
        > 0.9
        > report.metrics["epipolar_inlier_ratio_before"]
    )
    assert 0.001 < report.metrics["cameras_moved"]["median"] < 0.03
    back = np.array(report.metrics["file_from_world"])  # the file's world is kept
    file_centres = np.array([-p[:3, :3].T @ p[:3, 3] for p in rough.values()])
    ours = centres(have @ np.linalg.inv(back))
    assert np.linalg.norm(ours.mean(0) - file_centres.mean(0)) < 0.01


def test_cameras_of_a_split_are_not_refined(tmp_path: Path) -> None:
    path = tmp_path / "transforms.json"
    split_file(path)
    with pytest.raises(SplatError) as error:
        reconstructed(tmp_path / "sfm", path, 6, split=True, refine_cameras=True)
    assert error.value.code == "cameras-split-and-refined"


@pytest.mark.slow
def test_opengl_axes_where_a_model_has_others_are_refused(tmp_path: Path) -> None:
    turn = np.diag([1.0, -1.0, -1.0, 1.0])
    cameras = model(tmp_path / "cameras", lambda pose: turn @ pose, 5)
    with pytest.raises(SplatError) as caught:
        reconstructed(tmp_path / "sfm", cameras)
    assert caught.value.code == "cameras-do-not-fit"


@pytest.mark.slow
def test_cameras_for_pixels_that_exif_has_turned_are_named(tmp_path: Path) -> None:
    """Two of nine photographs were taken upside down, and their cameras are for stored pixels."""
    turned = list(POSES)[:9:8]
    cameras = model(tmp_path / "cameras", lambda pose: pose, 9)
    poses = [np.diag([-1.0, -1.0, 1.0, 1.0]) @ POSES[name] for name in turned]
    text = (cameras / "images.txt").read_text().split("\n")
    for name, pose in zip(turned, poses, strict=True):
        (line,) = [i for i, words in enumerate(text) if words.endswith(f" {name}")]
        words = [*text[line].split()[:1], *quaternions_of(pose[:3, :3]), *pose[:3, 3], 1, name]
        text[line] = " ".join(map(str, words))
    (cameras / "images.txt").write_text("\n".join(text))
    _, report = reconstructed(tmp_path / "sfm", cameras, 9)
    assert report.metrics["epipolar_inlier_ratio"] > 0.5
    ((code, message),) = report.warnings
    assert code == "cameras-some-do-not-fit"
    assert f"2 of 9 photographs do not fit their cameras: {', '.join(turned)}." in message
    assert f"Turned by 180 degrees they would fit: {', '.join(turned)}." in message


@pytest.mark.slow
def test_the_test_photographs_of_a_split_are_held_out_and_give_no_points(tmp_path: Path) -> None:
    path = tmp_path / "transforms.json"
    names = split_file(path)
    found, _ = reconstructed(tmp_path / "sfm", path, 6, split=True)
    training, judges = split_held_out(sfm.load(tmp_path / "sfm").views)
    assert [view.name for view in training] == names[:4]
    assert [view.name for view in judges] == names[4:5]
    assert found.tracks.max() <= 4
    without, _ = reconstructed(tmp_path / "all", path, 6)
    assert {view.role for view in without.views} == {""}
    assert len(without.views) == 6


@pytest.mark.parametrize("training", [0, 1])
def test_a_split_that_leaves_next_to_nothing_for_training_is_refused(
    tmp_path: Path, training: int
) -> None:
    path = tmp_path / "transforms.json"
    names = split_file(path)
    data = json.loads(path.read_text())
    data |= {"train_filenames": names[5 - training :], "test_filenames": names[: 5 - training]}
    path.write_text(json.dumps(data))
    with pytest.raises(SplatError) as caught:
        reconstructed(tmp_path / "sfm", path, 5, split=True, allow_partial=True)
    assert caught.value.code == "sfm-too-few-photographs"
    assert f"{training} photograph" in caught.value.given


def test_photographs_without_cameras_are_named(tmp_path: Path) -> None:
    cameras = model(tmp_path / "cameras", lambda pose: pose, 4)
    with pytest.raises(SplatError) as caught:
        reconstructed(tmp_path / "sfm", cameras)
    assert caught.value.code == "cameras-missing"
    assert list(POSES)[4] in caught.value.given
