"""The sfm stage, on the sample capture whose poses are known, and on captures that must fail."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from stages.base.errors import Family, SplatError
from stages.base.stage import Earlier, Report
from stages.run.request import Request, settings_to_data
from stages.scene import Capture, Reconstruction, split_held_out
from stages.sfm import stage as sfm
from stages.sfm.checks import fallbacks
from stages.sfm.settings import STAGE, SfmSettings
from tests import processes
from tests.sfm import room_captures
from tests.sfm.checks import bad_captures
from tests.sfm.interruptions import damage_database, digests, interrupted
from tests.sfm.truth import TRUTH, centres, similarity

FEW = SfmSettings(max_features=2000)  # enough for the sample, and quick


def failure(capture: Capture, folder: Path, **settings: object) -> SplatError:
    with pytest.raises(SplatError) as error:
        sfm.run({"ingest": capture}, SfmSettings(**settings), folder, Report())  # type: ignore[arg-type]
    return error.value


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> tuple[Reconstruction, Report, Path]:
    """Nine photographs of the sample capture."""
    folder, report = tmp_path_factory.mktemp("sfm"), Report()
    found = sfm.run({"ingest": bad_captures.sample(9)}, FEW, folder, report)
    return found, report, folder


def test_poses_and_lens_come_out_as_they_are_and_not_by_copying(
    small: tuple[Reconstruction, Report, Path],
) -> None:
    found, report, _ = small
    truth = json.loads(TRUTH.read_text())
    poses = {p["name"]: np.array(p["world_to_camera"]) for p in truth["photos"]}
    assert len(found.views) == 9
    wanted = np.array([poses[view.name] for view in found.views])
    have = np.array([view.camera.world_to_camera for view in found.views])
    turn, scale, shift = similarity(centres(have), centres(wanted))
    errors = np.linalg.norm(scale * centres(have) @ turn.T + shift - centres(wanted), axis=1)
    assert 1e-5 < errors.max() < 0.005  # metres, at 1.4 m
    relative = wanted[:, :3, :3] @ turn @ np.swapaxes(have[:, :3, :3], 1, 2)
    angles = np.degrees(np.arccos(np.clip((np.trace(relative, axis1=1, axis2=2) - 1) / 2, -1, 1)))
    assert 1e-4 < angles.max() < 0.3
    (focal,), (k,) = report.metrics["focal_px"], report.metrics["distortion"]
    assert focal == pytest.approx(600.0, rel=0.01)
    assert k == pytest.approx(-0.045, abs=0.005)


def test_pairs_are_counted(small: tuple[Reconstruction, Report, Path]) -> None:
    _, report, _ = small
    matched, verified = (report.metrics[f"pairs_{what}"] for what in ("matched", "verified"))
    assert 8 <= verified <= matched <= 36


def test_up_is_up_and_the_subject_is_at_the_origin(
    small: tuple[Reconstruction, Report, Path],
) -> None:
    found, report, _ = small
    truth = json.loads(TRUTH.read_text())
    poses = {p["name"]: np.array(p["world_to_camera"]) for p in truth["photos"]}
    for view in found.views:  # the true up, (0, -1, 0), seen by camera and brought back
        up = view.camera.world_to_camera[:3, :3].T @ poses[view.name][:3, :3] @ [0, -1, 0]
        assert up @ [0, -1, 0] > np.cos(np.radians(1.0))
    assert found.levelled
    assert report.metrics["levelled"] is True
    ahead = [v.camera.world_to_camera[:3, :3] @ -v.camera.centre for v in found.views]
    assert all(z > 0 for _, _, z in ahead)  # every camera has the origin before it


def test_undistorted_pictures_show_the_points_where_the_cameras_say(
    small: tuple[Reconstruction, Report, Path],
) -> None:
    found, _, folder = small
    differences = []
    for view in found.views:
        image = cv2.imread(str(folder / view.image))
        assert image is not None
        camera = view.camera
        assert image.shape[:2] == (camera.height, camera.width)
        xyz = found.points @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
        x = np.floor(camera.fx * xyz[:, 0] / xyz[:, 2] + camera.cx).astype(int)
        y = np.floor(camera.fy * xyz[:, 1] / xyz[:, 2] + camera.cy).astype(int)
        inside = (xyz[:, 2] > 0) & (x >= 0) & (y >= 0) & (x < camera.width) & (y < camera.height)
        seen = image[y[inside], x[inside], ::-1].astype(float)
        differences.append(np.abs(seen - found.colours[inside]).mean(axis=1))
    assert np.median(np.concatenate(differences)) < 12  # of 255; some points are hidden


def test_colmap_opens_the_model_that_was_written(
    small: tuple[Reconstruction, Report, Path],
) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    found, report, folder = small
    model = pycolmap.Reconstruction(folder / "colmap" / "sparse" / "0")
    assert model.num_reg_images() == 9
    assert model.num_points3D() == len(found.points) == report.metrics["points"]
    model.update_point_3d_errors()
    error = model.compute_mean_reprojection_error()
    assert error == pytest.approx(report.metrics["mean_reprojection_error_px"], rel=0.03)
    for view in found.views:
        image = model.find_image_with_name(Path(view.image).name)
        assert np.allclose(image.cam_from_world().matrix(), view.camera.world_to_camera[:3])
        assert (folder / "colmap" / "images" / image.name).exists()


def test_loading_gives_what_running_gave_and_needs_no_pictures(
    small: tuple[Reconstruction, Report, Path],
) -> None:
    found, _, folder = small
    loaded = sfm.load(folder)
    assert loaded.levelled == found.levelled
    for a, b in zip(loaded.views, found.views, strict=True):
        assert (a.name, a.image) == (b.name, b.image)
        assert (a.camera.world_to_camera == b.camera.world_to_camera).all()
        assert (a.camera.fx, a.camera.cx, a.camera.cy) == (b.camera.fx, b.camera.cx, b.camera.cy)
    for name in ("points", "colours", "errors_px", "tracks", "origin"):
        assert (getattr(loaded, name) == getattr(found, name)).all()


def test_only_finished_work_is_left(small: tuple[Reconstruction, Report, Path]) -> None:
    _, _, folder = small
    assert sorted(path.name for path in folder.iterdir()) == [
        "colmap",
        "colours.npy",
        "errors_px.npy",
        "points.npy",
        "reconstruction.json",
        "sfm.json",
        "tracks.npy",
    ]


def test_a_run_killed_after_its_end_reports_the_same_again(
    small: tuple[Reconstruction, Report, Path],
) -> None:
    _, first, folder = small
    again = Report()
    sfm.run({"ingest": bad_captures.sample(9)}, FEW, folder, again)
    timed = {"features_seconds", "matching_seconds", "mapping_seconds"}
    assert timed <= first.metrics.keys()
    untimed = {name: value for name, value in first.metrics.items() if name not in timed}
    assert json.loads(json.dumps(untimed)) == again.metrics
    assert [tuple(pair) for pair in first.warnings] == again.warnings


def test_blank_walls_have_too_few_features(tmp_path: Path) -> None:
    error = failure(bad_captures.blank(tmp_path / "in"), tmp_path)
    assert error.code == "sfm-too-few-features"
    assert error.family == Family.RECONSTRUCTION
    assert "patterned" in error.hint


def test_the_same_photograph_many_times_has_no_parallax(tmp_path: Path) -> None:
    error = failure(bad_captures.duplicates(tmp_path / "in", 5), tmp_path, max_features=1500)
    assert error.code == "sfm-no-parallax"
    assert "Walk around" in error.hint


def test_near_duplicates_are_refused_before_anything_is_searched(tmp_path: Path) -> None:
    capture = bad_captures.sample(6)
    photos = [
        replace(photo, duplicate_of=capture.photos[i // 3].name)
        for i, photo in enumerate(capture.photos)
    ]
    error = failure(replace(capture, photos=tuple(photos)), tmp_path)
    assert error.code == "sfm-no-parallax"
    assert "only 2 pictures" in error.given
    assert not (tmp_path / "work").exists()


def test_near_duplicates_among_others_are_named(tmp_path: Path) -> None:
    capture = bad_captures.sample(6)
    photos = list(capture.photos)
    first = photos[3].name
    photos[3:5] = [replace(photo, duplicate_of=first) for photo in photos[3:5]]
    report = Report()
    sfm.check_duplicates(replace(capture, photos=tuple(photos)), report)
    ((code, words),) = report.warnings
    assert code == "sfm-near-duplicates"
    assert words.startswith(
        f"1 of 6 photographs shows nearly the same as another: {photos[4].name}"
    )


@pytest.mark.slow
def test_every_photograph_there_twice_does_no_harm(tmp_path: Path) -> None:
    pictures = enumerate(bad_captures.pictures(7))
    twice = {f"{copy}{i}.png": picture for i, picture in pictures for copy in "ab"}
    capture = bad_captures.capture_of(tmp_path / "in", twice)
    found = sfm.run({"ingest": capture}, FEW, tmp_path, Report())
    assert away_m(found, [*range(7), *range(7)]).max() < 0.01


@pytest.mark.slow
def test_a_date_in_every_picture_does_no_harm(tmp_path: Path) -> None:
    capture = bad_captures.date_stamp(tmp_path / "in", 9)
    found = sfm.run({"ingest": capture}, FEW, tmp_path, Report())
    assert away_m(found, range(0, 18, 2)).max() < 0.01


def away_m(found: Reconstruction, taken: Sequence[int]) -> NDArray[np.float64]:
    """Metres by which each camera is off, all of them being those of the sample's photographs
    `taken`, in order."""
    truth = json.loads(TRUTH.read_text())["photos"]
    have = centres(np.array([view.camera.world_to_camera for view in found.views]))
    wanted = centres(np.array([truth[number]["world_to_camera"] for number in taken]))
    turn, scale, shift = similarity(have, wanted)
    lengths: NDArray[np.float64] = np.linalg.norm(scale * have @ turn.T + shift - wanted, axis=1)
    return lengths


@pytest.mark.slow
@pytest.mark.timeout(300)
@pytest.mark.parametrize(
    ("make", "code"),
    [
        (room_captures.turned_over, "sfm-contradictions"),
        (room_captures.same_poster_twice, "sfm-contradictions"),
        (room_captures.weakly_linked, "sfm-separate-groups"),
    ],
)
def test_a_plausible_model_that_is_wrong_is_refused(
    make: Callable[[Path], tuple[Capture, object]],
    code: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(
        fallbacks, "CONFIGURATIONS", (fallbacks.CONFIGURATIONS[0], fallbacks.CONFIGURATIONS[-1])
    )
    error = failure(make(tmp_path / "in")[0], tmp_path, max_features=1500)
    assert error.code == code


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_halves_joined_by_one_weak_pair_end_in_an_error_in_every_configuration(
    tmp_path: Path,
) -> None:
    room_captures.weakly_linked(tmp_path / "photos")
    run = str(tmp_path / "run")
    subprocess.run(processes.splat("ingest", str(tmp_path / "photos"), "--out", run), check=True)
    words = processes.splat("sfm", run, "--max-features", "1500")
    done = subprocess.run(words, capture_output=True, text=True)
    assert done.returncode != 0
    assert "sfm-separate-groups" in done.stderr
    assert not list(tmp_path.glob("run/2-sfm/reconstruction.json"))


@pytest.mark.slow
@pytest.mark.timeout(300)
@pytest.mark.parametrize("make", [bad_captures.sky, bad_captures.crowd])
def test_nothing_but_sky_or_people_is_refused(
    make: Callable[[Path], Capture], tmp_path: Path
) -> None:
    error = failure(make(tmp_path / "in"), tmp_path, max_features=1500)
    assert error.family is Family.RECONSTRUCTION


@pytest.mark.slow
def test_turning_on_the_spot_has_no_parallax(tmp_path: Path) -> None:
    capture = bad_captures.turning_on_the_spot(tmp_path / "in", 6)
    assert failure(capture, tmp_path, max_features=1500).code == "sfm-no-parallax"


@pytest.mark.slow
def test_zooming_has_no_parallax(tmp_path: Path) -> None:
    capture = bad_captures.zooming(tmp_path / "in", 6)
    assert failure(capture, tmp_path, max_features=1500).code == "sfm-no-parallax"


@pytest.mark.slow
def test_a_zoom_to_a_half_that_fits_a_flat_poster_is_refused(tmp_path: Path) -> None:
    capture = bad_captures.zooming_into_detail(tmp_path / "in")
    error = failure(capture, tmp_path, max_features=3000)
    assert error.code == "sfm-no-parallax"
    assert "zoom" in error.hint


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_two_scenes_are_separated_and_one_may_be_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        fallbacks, "CONFIGURATIONS", fallbacks.CONFIGURATIONS[:1]
    )  # the others take minutes
    capture = bad_captures.two_scenes(tmp_path / "in", each=6)
    assert failure(capture, tmp_path, max_features=1500).code == "sfm-separate-groups"
    report = Report()
    settings = SfmSettings(max_features=1500, allow_partial=True)
    found = sfm.run({"ingest": capture}, settings, tmp_path, report)
    assert len(found.views) == 6
    assert len({view.name[0] for view in found.views}) == 1
    codes = [code for code, _ in report.warnings]
    assert "sfm-photographs-left-out" in codes
    assert "sfm-separate-groups" in codes


def test_what_says_how_large_the_scene_is_may_change_on_resuming() -> None:
    """Photographs are matched without it; hours of work go on."""

    def key(settings: SfmSettings) -> dict[str, Any]:
        return Request(STAGE, settings_to_data(settings), {}, {}).key()

    placed = SfmSettings(marker=0.05, crs="EPSG:25832", allow_partial=True, hold_out=False)
    assert key(placed) == key(SfmSettings(scale=("a.jpg", "b.jpg", "1"))) == key(SfmSettings())
    assert key(SfmSettings(features="sift")) != key(SfmSettings())


def test_a_run_killed_after_its_end_is_not_taken_for_one_of_another_scale(
    small: tuple[Reconstruction, Report, Path], tmp_path: Path
) -> None:
    found, _, folder = small
    again = tmp_path / "again"
    shutil.copytree(folder, again)
    first, last = found.views[0].name, found.views[-1].name
    report = Report()
    known = replace(FEW, scale=(first, last, "3"))
    sfm.run({"ingest": bad_captures.sample(9)}, known, again, report)
    assert report.metrics["scale_source"] == f"{first} and {last} are 3 m apart"


def test_which_views_are_held_out_changes_nothing_else_and_takes_no_search(
    small: tuple[Reconstruction, Report, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def earlier(folder: Path, report: Report, *same: str) -> Report:
        settings = settings_to_data(FEW)
        return Report(
            earlier=Earlier(
                folder, settings, report.metrics, report.warnings, frozenset(same), outputs
            )
        )

    capture, all_trained = bad_captures.sample(9), replace(FEW, hold_out=False)
    first, first_report, first_folder = small
    outputs = frozenset(digests(first_folder))
    sfm.run({"ingest": capture}, all_trained, tmp_path / "whole", Report())
    other = earlier(first_folder, first_report, "something else")
    monkeypatch.setattr(sfm, "_from_photographs", None)
    with pytest.raises(TypeError):  # it would search
        sfm.run({"ingest": capture}, all_trained, tmp_path / "other", other)
    again = earlier(first_folder, first_report, "ingest")
    foreign = first_folder / "colmap" / "images" / ".DS_Store"
    foreign.write_text("of the Finder")
    found = sfm.run({"ingest": capture}, all_trained, tmp_path / "again", again)
    foreign.unlink()
    assert split_held_out(found.views)[1] == ()
    assert split_held_out(first.views)[1]
    assert digests(tmp_path / "again") == digests(tmp_path / "whole")
    assert again.metrics == json.loads(json.dumps(first_report.metrics))
    back = earlier(tmp_path / "again", again, "ingest")
    sfm.run({"ingest": capture}, FEW, tmp_path / "back", back)
    assert digests(tmp_path / "back") == digests(first_folder)


def test_two_photographs_are_too_few(tmp_path: Path) -> None:
    """Ingest refuses them first; pairs of near-duplicates are refused here."""
    assert failure(bad_captures.sample(2), tmp_path).code == "sfm-no-parallax"


def test_a_time_limit_is_an_error(tmp_path: Path) -> None:
    error = failure(bad_captures.sample(4), tmp_path, max_minutes=0.001)
    assert error.code == "sfm-timed-out"


def test_stopping_leaves_work_to_go_on_with(tmp_path: Path) -> None:
    interrupted(bad_captures.sample(5), tmp_path, FEW)
    assert (tmp_path / "work" / "base.features-done").exists()
    assert not (tmp_path / "sfm.json").exists()


@pytest.mark.slow
@pytest.mark.parametrize("how", ["empty", "header"])
def test_a_damaged_database_is_made_again(
    small: tuple[Reconstruction, Report, Path], tmp_path: Path, how: str
) -> None:
    interrupted(bad_captures.sample(9), tmp_path, FEW)
    (tmp_path / "work" / "base.auto-done").touch()  # as after matching
    damage_database(tmp_path / "work" / "base.db", how)
    sfm.run({"ingest": bad_captures.sample(9)}, FEW, tmp_path, Report())
    assert digests(tmp_path) == digests(small[2])


@pytest.mark.parametrize("damage", ["points.npy", "reconstruction.json"])
@pytest.mark.parametrize("how", ["missing", "cut", "garbage"])
def test_damaged_folders_are_refused(
    small: tuple[Reconstruction, Report, Path], tmp_path: Path, damage: str, how: str
) -> None:
    found, _, _ = small
    from stages.sfm.reconstruction_files import save_reconstruction

    save_reconstruction(tmp_path, found)
    path = tmp_path / damage
    content = path.read_bytes()
    path.unlink()
    if how != "missing":
        path.write_bytes(content[:100] if how == "cut" else b"\x93NUMPY garbage" * 9)
    with pytest.raises(SplatError) as error:
        sfm.load(tmp_path)
    assert error.value.code == "reconstruction-damaged"


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_killed_at_any_moment_a_run_ends_in_the_same_bytes(
    small: tuple[Reconstruction, Report, Path], tmp_path: Path
) -> None:
    _, _, whole = small
    code = (
        "from pathlib import Path; from stages.base.stage import Report;"
        "from stages.sfm import stage as sfm; from stages.sfm.settings import SfmSettings;"
        "from tests.sfm.checks import bad_captures as b;"
        "s = SfmSettings(max_features=2000);"
        "sfm.run({'ingest': b.sample(9)}, s, Path(sys.argv[1]), Report())"
    )
    folder = tmp_path / "killed"
    folder.mkdir()
    seed = int(os.environ.get("SPLAT_TEST_SEED", int.from_bytes(os.urandom(4), "little")))
    print(f"SPLAT_TEST_SEED={seed}")  # shown if it fails
    random = np.random.default_rng(seed)
    for _ in range(10):
        with processes.running(processes.python(code, str(folder))):
            time.sleep(float(random.uniform(0.5, 5.0)))
    subprocess.run(processes.python(code, str(folder)), check=True)
    assert digests(folder) == digests(whole)
