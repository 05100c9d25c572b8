"""Panoramas are COLMAP's rigs: their faces are placed together, and count as one."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from stages.base.stage import Report
from stages.ingest import stage as ingest
from stages.ingest.faces import DIRECTIONS, face_rotation
from stages.ingest.settings import IngestSettings
from stages.scene import Capture, Face, Photo
from stages.scene.rotations import matrices_of, quaternions_of
from stages.sfm import stage as sfm
from stages.sfm.checks.statistics import model_statistics
from stages.sfm.settings import SfmSettings
from stages.sfm.worker import pairs
from stages.sfm.worker.job import Mapping, project_of
from stages.sfm.worker.sparse_model import MappingResult, without_implausible_views
from tests.benchmarks import panoramas
from tests.sfm.synthetic import orbit_model

FACES = len(DIRECTIONS)


def photo(name: str, camera: str, face: Face | None = None) -> Photo:
    return Photo(name, f"photos/{name}.jpg", 480, 480, 240.0, camera, 1.0, 0.0, None, face=face)


def capture(folder: Path, panoramas: int) -> Capture:
    """So many panoramas, and one photograph after them."""
    found = []
    for number in range(panoramas):
        for at in DIRECTIONS:
            w, x, y, z = quaternions_of(face_rotation(*at)).tolist()
            face = Face("round", f"{number}.jpg", (w, x, y, z))
            found.append(photo(f"{number}.jpg/{at}", f"round {at}", face))
    return Capture(folder, (*found, photo("plain.jpg", "plain")))


def test_the_database_has_the_rig_with_the_turns_that_faces_were_cut_at(tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    from stages.sfm.worker import new_database

    project = project_of(capture(tmp_path, 2), tmp_path, 0)
    path = tmp_path / "rig.db"
    new_database.create(path, project.photographs)
    with pycolmap.Database.open(path) as database:
        rig, plain = sorted(database.read_all_rigs(), key=lambda rig: -rig.num_sensors())
        frames = database.read_all_frames()
        cameras = {camera.camera_id: camera for camera in database.read_all_cameras()}
    assert (rig.num_sensors(), plain.num_sensors()) == (FACES, 1)
    assert sorted(len(list(frame.data_ids)) for frame in frames) == [1, FACES, FACES]
    reference = face_rotation(*DIRECTIONS[0])
    for camera_id, at in enumerate(DIRECTIONS[1:], 2):
        pose = rig.sensor_from_rig(cameras[camera_id].sensor_id)
        assert np.allclose(pose.rotation.matrix(), face_rotation(*at) @ reference.T, atol=1e-12)
        assert np.abs(pose.translation).max() == 0.0
        assert cameras[camera_id].params.tolist() == [240.0, 240.0, 240.0, 0.0]


@pytest.mark.parametrize("single", [0, 1])
def test_limits_of_the_mapper_count_panoramas(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, single: int
) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    from stages.sfm.worker import mapping

    taken = capture(tmp_path, 4)
    taken = replace(taken, photos=taken.photos[: 4 * FACES + single])
    found = []

    def mapped(*arguments: Any, **_: Any) -> dict[int, Any]:
        found.append(arguments[3])
        return {}

    monkeypatch.setattr(pycolmap, "incremental_mapping", mapped)
    mapping.map_photographs(Mapping(project_of(taken, tmp_path, 0), tmp_path / "model", 60))
    (options,) = found
    assert (
        options.max_model_overlap == FACES * pycolmap.IncrementalPipelineOptions().max_model_overlap
    )
    assert options.min_model_size == mapping.SMALLEST_MODEL * (1 if single else FACES)


def test_no_two_faces_of_one_panorama_are_matched(tmp_path: Path) -> None:
    frames = project_of(capture(tmp_path, 2), tmp_path, 0).photographs.frames
    assert frames.tolist() == [0] * FACES + [1] * FACES + [2]
    found = pairs.pairs_of_faces(pairs.exhaustive_pairs(3), frames)
    assert len(found) == len(set(found)) == FACES * FACES + 2 * FACES
    assert all(i < j and frames[i] != frames[j] for i, j in found)
    alike = np.full((len(frames), len(frames)), 50, np.int32)
    more = pairs.linking_pairs(alike, [], {}, frames)
    assert more
    assert all(frames[i] != frames[j] for i, j in more)


def test_a_bare_face_of_a_panorama_that_is_linked_needs_no_more_pairs() -> None:
    frames = np.repeat(np.arange(6), 2)  # of each panorama, only the first face sees anything
    alike = np.ones((12, 12), np.int32)
    linked = {(2 * i, 2 * j): 90 for i, j in pairs.exhaustive_pairs(6)}
    assert pairs.linking_pairs(alike, linked, linked, frames) == []
    assert pairs.linking_pairs(alike, linked, linked) != []  # of photographs the others are alone


def test_a_face_without_points_stays_and_faces_are_counted_as_their_panorama() -> None:
    model = orbit_model(12, 400)
    seen = model.observing_views != 3
    kept = {
        name: getattr(model, name)[seen]
        for name in ("observed_points", "observing_views", "observed_px")
    }
    bare = replace(model, **kept)
    assert len(without_implausible_views(bare).names) == 11
    rig = replace(bare, view_frames=np.repeat(np.arange(6, dtype=np.int32), 2))
    assert len(without_implausible_views(rig).names) == 12
    result = MappingResult(rig, (("a",) * 6,), timed_out=False)
    statistics = model_statistics(result, 6)
    assert (statistics.registered, statistics.left_out) == (6, 0)


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_panoramas_of_the_sample_are_placed_within_two_millimetres(tmp_path: Path) -> None:
    folder = tmp_path / "photos"
    folder.mkdir()
    for number in range(panoramas.PANORAMAS):
        panoramas.draw(number, folder, 768)
    found = ingest.run({"photos": folder}, IngestSettings(), tmp_path / "1", Report())
    report = Report()
    reconstruction = sfm.run({"ingest": found}, SfmSettings(), tmp_path / "2", report)
    assert len(reconstruction.views) == panoramas.PANORAMAS * FACES
    away = np.linalg.norm(panoramas.errors_mm(reconstruction.views), axis=1)
    assert len(away) == panoramas.PANORAMAS
    assert away.max() < 2.0  # at 1.4 m from the subject
    turns = {p.name: p.face.turn for p in found.photos if p.face}
    first = {view.frame: view for view in reversed(reconstruction.views)}
    for view in reconstruction.views:
        one = first[view.frame]
        relative = view.camera.world_to_camera @ np.linalg.inv(one.camera.world_to_camera)
        turn, reference = (matrices_of(np.array(turns[v.name])) for v in (view, one))
        assert np.allclose(relative[:3, :3], turn @ reference.T, atol=1e-9)
        assert np.abs(relative[:3, 3]).max() < 1e-9
        picture = Image.open(reconstruction.folder / view.image)
        assert picture.size == (view.camera.width, view.camera.height)
    assert set(report.metrics["distortion"]) == {0.0}
