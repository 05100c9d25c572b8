"""Splats of other programs and runs: brought into this run's world, and read as they were
trained."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from stages import formats
from stages.base.errors import SplatError
from stages.base.stage import Report
from stages.raster.draw import render
from stages.raster.similarity import Similarity, rotation_about
from stages.scene import IGNORE, DrawSettings, Splats
from stages.scene.storage import save_splats
from stages.seed import given, stage
from stages.seed.given import given_splats
from stages.seed.settings import SeedSettings
from stages.seed.worlds import NERFSTUDIO
from stages.sfm.reconstruction_files import load_reconstruction, save_reconstruction
from tests.small_scene import SmallScene, small_scene

TO_FILE = Similarity(2.5, rotation_about(np.array([1.0, 2.0, 0.5]), 70), np.array([3.0, -8.0, 1.0]))
HALF_TURN = Similarity(rotation=np.diag([1.0, -1.0, -1.0]))


def matrix(similarity: Similarity) -> np.ndarray:
    return np.linalg.inv(similarity.inverse_matrix)


@pytest.fixture
def scene(tmp_path: Path) -> SmallScene:
    """Its cameras came from a file whose world is another."""
    made = small_scene(tmp_path)
    points = made.splats.means.astype(np.float64) * (1.0, 0.7, 0.4)
    world = replace(made.reconstruction, file_from_world=matrix(TO_FILE), points=points)
    return SmallScene(made.splats, world)


def written(folder: Path, splats: Splats, moved: Similarity) -> Path:
    path = folder / "other" / "point_cloud.ply"
    path.parent.mkdir()
    formats.write(path, moved.apply_to_splats(splats))
    return path


def check_same(found: Splats, splats: Splats) -> None:
    """The pictures are the test of rotations and of colours that depend on the view."""
    np.testing.assert_allclose(found.means, splats.means, atol=2e-5)
    np.testing.assert_allclose(found.log_scales, splats.log_scales, atol=1e-4)


@pytest.mark.parametrize("turned", [False, True])
def test_the_worlds_of_the_file_and_of_the_cameras_become_the_runs(
    scene: SmallScene, tmp_path: Path, turned: bool
) -> None:
    moved = HALF_TURN.after(TO_FILE) if turned else TO_FILE
    path, report = written(tmp_path, scene.splats, moved), Report()
    found = given_splats(path, scene.reconstruction, report)
    check_same(found, scene.splats)
    np.testing.assert_array_equal(found.origin, scene.reconstruction.origin)
    turning = ", turned over" if turned else ""
    assert report.metrics["given_world"] == f"the cameras' world{turning}"
    assert report.metrics["given_world_db"] > report.metrics["next_world_db"]
    assert report.metrics["given_drawing"] == "plain"
    assert report.metrics["given_drawing_db"] > report.metrics["other_drawing_db"]
    for view in scene.reconstruction.views[:3]:
        drawn, true = (render(each, view.camera).image for each in (found, scene.splats))
        assert np.abs(drawn - true).max() < 1e-3


def test_splats_that_were_trained_for_antialiased_drawing_are_drawn_so(
    scene: SmallScene, tmp_path: Path
) -> None:
    fine = replace(
        scene.splats,
        log_scales=scene.splats.log_scales - 1.5,
        draw_settings=DrawSettings(antialias=True),
    )
    for view in scene.reconstruction.views:
        image = np.clip(render(fine, view.camera).image, 0, 1)
        Image.fromarray(np.uint8(image * 255 + 0.5)).save(tmp_path / view.image)
    path, report = written(tmp_path, fine, TO_FILE), Report()
    assert given_splats(path, scene.reconstruction, report).draw_settings.antialias
    assert report.metrics["given_drawing"] == "antialiased"


def test_nerfstudios_normalised_world_is_read_from_beside_the_splats(
    scene: SmallScene, tmp_path: Path
) -> None:
    normalised = Similarity(0.31, rotation_about(np.array([0, 1.0, 1.0]), 200), np.ones(3))
    path = written(tmp_path, scene.splats, normalised.after(TO_FILE))
    transform = matrix(normalised)[:3] / 0.31
    data = {"transform": transform.tolist(), "scale": 0.31}
    (path.parent / NERFSTUDIO).write_text(json.dumps(data))
    report = Report()
    check_same(given_splats(path, scene.reconstruction, report), scene.splats)
    assert "nerfstudio" in report.metrics["given_world"]
    (path.parent / NERFSTUDIO).write_text('{"transform": [1, 2], "scale": 1}')
    with pytest.raises(SplatError) as caught:
        given_splats(path, scene.reconstruction, Report())
    assert caught.value.code == "splats-unreadable"
    assert NERFSTUDIO in caught.value.given


@pytest.mark.parametrize("below", [".", "point_cloud/iteration_30000"])
def test_the_world_of_a_cameras_json_beside_the_splats_is_read(
    scene: SmallScene, tmp_path: Path, below: str
) -> None:
    """As OpenSplat writes it, and two folders up as the reference trainer does; names lack their
    folder and suffix there, and may have a dot."""
    views = [replace(v, name=f"day/take.{v.name}") for v in scene.reconstruction.views]
    scene = replace(scene, reconstruction=replace(scene.reconstruction, views=tuple(views)))
    unknown = Similarity(0.013, rotation_about(np.array([1.0, -2.0, 0.3]), 131), np.arange(3.0))
    moved = unknown.after(TO_FILE)
    path = written(tmp_path, scene.splats, moved)
    entries = []
    for view in scene.reconstruction.views:
        camera = moved.apply_to_camera(view.camera)
        pose = np.linalg.inv(camera.world_to_camera)
        entries.append(
            {
                "img_name": view.name.removeprefix("day/").removesuffix(".png"),
                "width": camera.width,
                "height": camera.height,
                "fx": camera.fx,
                "fy": camera.fy,
                "rotation": pose[:3, :3].tolist(),
                "position": pose[:3, 3].tolist(),
            }
        )
    (path.parent / "cameras.json").write_text(json.dumps(entries))
    deeper = path.parent / below / path.name
    deeper.parent.mkdir(parents=True, exist_ok=True)
    path.rename(deeper)
    report = Report()
    check_same(given_splats(deeper, scene.reconstruction, report), scene.splats)
    assert report.metrics["given_world"] == "the world of cameras.json"


def test_opensplats_centred_world_is_found(scene: SmallScene, tmp_path: Path) -> None:
    cameras = [TO_FILE.apply_to_camera(view.camera) for view in scene.reconstruction.views]
    centres = np.array([camera.centre for camera in cameras])
    middle = centres.mean(axis=0)
    scale = 1 / np.abs(centres - middle).max()
    moved = Similarity(scale, np.eye(3), -scale * middle).after(TO_FILE)
    path, report = written(tmp_path, scene.splats, moved), Report()
    check_same(given_splats(path, scene.reconstruction, report), scene.splats)
    assert report.metrics["given_world"] == "OpenSplat's centred world"


def test_the_world_that_gsplat_normalises_to_is_found(scene: SmallScene, tmp_path: Path) -> None:
    """By the formulas of its examples/datasets/normalize.py, written out with matrices."""
    to_file = scene.reconstruction.file_from_world
    assert to_file is not None
    cameras = [np.linalg.inv(v.camera.world_to_camera) for v in scene.reconstruction.views]
    poses = np.array([to_file @ pose for pose in cameras])
    axes, centres = poses[:, :3, :3] / np.cbrt(np.linalg.det(to_file[:3, :3])), poses[:, :3, 3]
    up = -axes[:, :, 1].mean(0) / np.linalg.norm(axes[:, :, 1].mean(0))
    across = np.cross(up, [0, -1, 0])
    turn = rotation_about(across, np.degrees(np.arccos(-up[1])))
    np.testing.assert_allclose(turn @ up, [0, -1, 0], atol=1e-12)
    at, ahead = centres @ turn.T, axes[:, :, 2] @ turn.T
    middle = np.median([p - (p @ a) * a for p, a in zip(at, ahead, strict=True)], axis=0)
    scale = 1 / np.median(np.linalg.norm(at - middle, axis=1))
    first = Similarity(scale, turn, -scale * middle)
    ones = np.ones((len(scene.reconstruction.points), 1))
    points = np.hstack([scene.reconstruction.points, ones]) @ (matrix(first) @ to_file)[:3].T
    values, vectors = np.linalg.eigh(np.cov(points.T))
    assert values[0] < values[1] < values[2]
    rotation = vectors[:, ::-1].T
    rotation[1] *= np.sign(np.linalg.det(rotation))
    second = Similarity(1.0, rotation, -rotation @ np.median(points, axis=0))
    moved = second.after(first).after(TO_FILE)
    path, report = written(tmp_path, scene.splats, moved), Report()
    check_same(given_splats(path, scene.reconstruction, report), scene.splats)
    assert report.metrics["given_world"] == "gsplat's normalised world"


def test_splats_of_another_scene_are_refused_with_both_figures(
    scene: SmallScene, tmp_path: Path
) -> None:
    far = Similarity(1.0, np.eye(3), np.array([0.0, 40.0, 0.0]))
    path = written(tmp_path, scene.splats, far.after(TO_FILE))
    settings = SeedSettings(splats=path)
    with pytest.raises(SplatError) as caught:
        stage.run({"sfm": scene.reconstruction}, settings, tmp_path, Report())
    assert caught.value.code == "seed-splats-do-not-fit"
    assert caught.value.given.count(" dB") == 2
    assert not (tmp_path / "splats.bin").exists()


def test_a_masked_photograph_does_not_let_splats_of_another_scene_pass(
    scene: SmallScene, tmp_path: Path
) -> None:
    view, *others = scene.reconstruction.views
    empty = np.zeros((view.camera.height, view.camera.width), np.uint8)
    Image.fromarray(empty).save(scene.reconstruction.folder / "none.png")
    views = (replace(view, mask="none.png", outside=IGNORE), *others)
    far = Similarity(1.0, np.eye(3), np.array([0.0, 40.0, 0.0]))
    path = written(tmp_path, scene.splats, far.after(TO_FILE))
    with pytest.raises(SplatError) as caught:
        given_splats(path, replace(scene.reconstruction, views=views), Report())
    assert caught.value.code == "seed-splats-do-not-fit"


def test_splats_need_the_cameras_that_they_were_trained_with(
    scene: SmallScene, tmp_path: Path
) -> None:
    path = written(tmp_path, scene.splats, TO_FILE)
    own = replace(scene.reconstruction, file_from_world=None)
    for reconstruction, file, code in (
        (own, path, "seed-splats-without-cameras"),
        (scene.reconstruction, tmp_path / "none.ply", "splats-unreadable"),
        (scene.reconstruction, tmp_path / "00.png", "format-unknown"),
    ):
        with pytest.raises(SplatError) as caught:
            given_splats(file, reconstruction, Report())
        assert caught.value.code == code
        assert str(file) in caught.value.given


def test_what_cannot_be_drawn_is_left_out_and_said(scene: SmallScene, tmp_path: Path) -> None:
    path = written(tmp_path, scene.splats, TO_FILE)
    data = bytearray(path.read_bytes())
    start = data.index(b"end_header\n") + len(b"end_header\n")
    data[start : start + 4] = np.float32(np.nan).tobytes()
    path.write_bytes(data)
    report = Report()
    found = given_splats(path, scene.reconstruction, report)
    assert len(found) == len(scene.splats) - 1
    assert [code for code, _ in report.warnings] == [
        "seed-splats-dropped",
        "seed-held-out-unknown",
    ]


def test_more_splats_than_memory_holds_are_refused_before_they_are_drawn(
    scene: SmallScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = written(tmp_path, scene.splats, TO_FILE)
    monkeypatch.setattr(given, "available_mib", lambda: 0.1)
    with pytest.raises(SplatError) as caught:
        given_splats(path, scene.reconstruction, Report())
    assert caught.value.code == "seed-splats-memory"
    assert "--decimate 32" in caught.value.hint  # half of what 0.1 MiB hold


def earlier_run(folder: Path, scene: SmallScene, moved: Similarity) -> Path:
    """The splats that a run trained whose world is `moved`; its camera of the first photograph is
    wrong, and it did not hold out the ninth."""
    views = [replace(v, camera=moved.apply_to_camera(v.camera)) for v in scene.reconstruction.views]
    views[0] = replace(views[0], camera=views[1].camera)
    origin = np.array([7.0, 8.0, 9.0])
    (folder / "2-sfm").mkdir(parents=True)
    (folder / "4-train").mkdir()
    reconstruction = replace(
        scene.reconstruction, views=tuple(views), origin=origin, points=np.zeros((0, 3))
    )
    save_reconstruction(folder / "2-sfm", reconstruction)
    splats = moved.apply_to_splats(scene.splats)
    means = (splats.means + splats.origin).astype(np.float32)
    drawn = DrawSettings(antialias=True)
    splats = replace(splats, means=means, origin=origin, draw_settings=drawn)
    return save_splats(folder / "4-train", splats)


def test_the_world_of_an_earlier_run_follows_from_the_shared_photographs(
    scene: SmallScene, tmp_path: Path
) -> None:
    """One of the ten cameras was placed wrongly there, and does not count."""
    path, report = earlier_run(tmp_path / "run", scene, TO_FILE), Report()
    estimated = replace(scene.reconstruction, file_from_world=None)
    found = given_splats(path, estimated, report)
    check_same(found, scene.splats)
    np.testing.assert_array_equal(found.origin, estimated.origin)
    assert found.draw_settings.antialias
    assert report.metrics["given_world"] == "the earlier run's world"
    assert "other_drawing_db" not in report.metrics


def test_equal_cameras_give_equal_splats(scene: SmallScene, tmp_path: Path) -> None:
    path = earlier_run(tmp_path / "run", scene, TO_FILE)
    moved = [
        replace(v, camera=TO_FILE.apply_to_camera(v.camera)) for v in scene.reconstruction.views
    ]
    own = load_reconstruction(tmp_path / "run" / "2-sfm")
    save_reconstruction(tmp_path / "run" / "2-sfm", replace(own, views=tuple(moved)))
    check_same(given_splats(path, scene.reconstruction, Report()), scene.splats)


def test_held_out_photographs_that_the_earlier_run_trained_on_are_said(
    scene: SmallScene, tmp_path: Path
) -> None:
    path, report = earlier_run(tmp_path / "run", scene, Similarity()), Report()
    given_splats(path, scene.reconstruction, report)
    assert report.warnings == []
    views = scene.reconstruction.views
    changed = tuple(replace(v, role="test" if v.name == "03.png" else "train") for v in views)
    given_splats(path, replace(scene.reconstruction, views=changed), report)
    assert "1 photograph " in dict(report.warnings)["seed-held-out-unknown"]


def test_an_earlier_run_of_other_photographs_is_refused(scene: SmallScene, tmp_path: Path) -> None:
    path = earlier_run(tmp_path / "run", scene, Similarity())
    renamed = (
        view if i < 2 else replace(view, name=f"b{view.name}")
        for i, view in enumerate(scene.reconstruction.views)
    )
    with pytest.raises(SplatError) as caught:
        given_splats(path, replace(scene.reconstruction, views=tuple(renamed)), Report())
    assert caught.value.code == "seed-splats-do-not-fit"
    assert "2 photographs" in caught.value.given


def test_first_splats_are_added_only_where_given_ones_leave_photographs_uncovered(
    scene: SmallScene, tmp_path: Path
) -> None:
    """The lower end of the scene is missing. Points are in its middle and at that end."""
    kept = scene.splats[scene.splats.means[:, 1] < 0.3]
    path = written(tmp_path, kept, TO_FILE)
    rng = np.random.default_rng(5)
    middle = rng.uniform((-0.2, -0.3, -0.2), (0.2, 0.1, 0.2), (200, 3))
    below = rng.uniform((-0.2, 0.9, -0.2), (0.2, 1.1, 0.2), (200, 3))
    world = replace(
        scene.reconstruction,
        points=np.concatenate([middle, below]),
        colours=np.full((400, 3), 90, np.uint8),
        errors_px=np.zeros(400),
        tracks=np.full(400, 3, np.int32),
    )
    settings = SeedSettings(splats=path, fill=False)
    assert len(stage.run({"sfm": world}, settings, tmp_path, Report())) == len(kept)
    report = Report()
    found = stage.run({"sfm": world}, replace(settings, densify=True), tmp_path, report)
    check_same(found[: len(kept)], kept)
    np.testing.assert_array_equal(found.origin, world.origin)
    added = found.means[len(kept) :]
    assert len(added) == report.metrics["added_to_given"] >= 150
    assert (added[:, 1] > 0.5).all()


def test_given_splats_need_no_points_to_be_densified(scene: SmallScene, tmp_path: Path) -> None:
    path = written(tmp_path, scene.splats, TO_FILE)
    settings = SeedSettings(splats=path, fill=False, densify=True)
    world = replace(scene.reconstruction, points=np.zeros((0, 3)))
    assert len(stage.run({"sfm": world}, settings, tmp_path, Report())) == len(scene.splats)
