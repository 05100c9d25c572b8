"""The sfm stage with known cameras of wide fisheyes: their faces are placed as the photographs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from stages.base.errors import SplatError
from stages.base.stage import Report
from stages.ingest import stage as ingest
from stages.ingest.faces import face_rotation
from stages.ingest.settings import IngestSettings
from stages.scene import Reconstruction, split_held_out
from stages.scene.rotations import quaternions_of
from stages.sfm import stage as sfm
from stages.sfm.settings import SfmSettings
from tests import tolerances
from tests.benchmarks import fisheyes
from tests.sfm.truth import off_by

SIDE, COUNT = 320, 6
FACES = 5
pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six circular fisheye pictures of 180 degrees of the sample's scene, and their cameras."""
    folder = tmp_path_factory.mktemp("fisheyes")
    (folder / "photos").mkdir()
    for number in range(COUNT):
        fisheyes.draw(number, folder / "photos", SIDE)
    return folder


def reconstructed(
    capture: Path, folder: Path, poses: list[np.ndarray], **more: object
) -> tuple[Reconstruction, Report]:
    fisheyes.write_cameras(folder / "cameras", SIDE)
    lines = []
    for number, pose in enumerate(poses):
        words = [number + 1, *quaternions_of(pose[:3, :3]), *pose[:3, 3], 1, fisheyes.name(number)]
        lines.append(" ".join(map(str, words)) + "\n\n")
    (folder / "cameras" / "images.txt").write_text("".join(lines))
    photos = {"photos": capture / "photos"}
    found = ingest.run(photos, IngestSettings(), folder / "1", Report())
    settings = SfmSettings(max_features=2000, cameras=folder / "cameras", **more)  # type: ignore[arg-type]
    report = Report()
    return sfm.run({"ingest": found}, settings, folder / "2", report), report


def photograph_poses(found: Reconstruction, report: Report) -> dict[str, np.ndarray]:
    """[4, 4] the pose of each photograph in the file's world, which all its faces agree on."""
    back = np.linalg.inv(np.array(report.metrics["file_from_world"]))
    poses: dict[str, np.ndarray] = {}
    for view in found.views:
        pose = view.camera.world_to_camera @ back
        pose[:3] = turn_of(view.name).T @ pose[:3]
        np.testing.assert_allclose(pose, poses.setdefault(view.frame, pose), atol=1e-9)
    return poses


def turn_of(name: str) -> np.ndarray:
    """[3, 3] from the photograph to its face, by the face's name."""
    at = name.rsplit("/", 1)[1]
    return face_rotation(int(at[:3]), int(at[3:]))


def test_faces_keep_the_given_poses_and_count_as_their_photographs(
    capture: Path, tmp_path: Path
) -> None:
    true = fisheyes.poses()[:COUNT]
    found, report = reconstructed(capture, tmp_path, true)
    assert len(found.views) == FACES * COUNT
    assert report.metrics["wide_fisheyes"] == COUNT
    assert report.metrics["unregistered_images"] == []
    assert report.metrics["points_source"] == "triangulation"
    assert report.metrics["epipolar_inlier_ratio"] > 0.9
    poses = photograph_poses(found, report)
    for number, pose in enumerate(true):
        np.testing.assert_allclose(poses[fisheyes.name(number)], pose, atol=1e-9)
    assert found.levelled
    up = np.array(report.metrics["file_from_world"])[:3, 1]
    assert np.degrees(np.arccos(up[1])) < 3.0  # the sample's world is level, with y down
    training, held_out = split_held_out(found.views)
    assert {view.frame for view in held_out} == {fisheyes.name(0)}
    assert (len(training), len(held_out)) == (FACES * (COUNT - 1), FACES)


def test_opengl_axes_where_a_model_has_others_are_refused(capture: Path, tmp_path: Path) -> None:
    turn = np.diag([1.0, -1.0, -1.0, 1.0])
    with pytest.raises(SplatError) as caught:
        reconstructed(capture, tmp_path, [turn @ pose for pose in fisheyes.poses()[:COUNT]])
    assert caught.value.code == "cameras-do-not-fit"


def test_rough_poses_are_refined_and_faces_stay_together(capture: Path, tmp_path: Path) -> None:
    random = np.random.default_rng(1)
    true = fisheyes.poses()[:COUNT]
    rough = [off_by(pose, 0.5, 0.01, random) for pose in true]
    found, report = reconstructed(capture, tmp_path, rough, refine_cameras=True)
    poses = photograph_poses(found, report)
    relative = [poses[fisheyes.name(number)] for number in range(COUNT)]

    def off(these: list[np.ndarray]) -> float:
        """Mean error of the turns between photographs, degrees."""
        steps = [
            (b[:3, :3] @ a[:3, :3].T) @ (d[:3, :3] @ c[:3, :3].T).T
            for a, b, c, d in zip(these, these[1:], true, true[1:], strict=False)
        ]
        cosines = [np.clip((np.trace(step) - 1) / 2, -1, 1) for step in steps]
        return float(np.degrees(np.arccos(cosines)).mean())

    assert off(relative) < tolerances.REFINED_FISHEYE * off(rough)
