"""Learned features: what they find, which pairs they match, and photographs that they join."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from stages.base.errors import SplatError
from stages.base.stage import Report
from stages.ingest import stage as ingest
from stages.ingest.settings import IngestSettings
from stages.sfm import stage as sfm
from stages.sfm.checks import acceptance
from stages.sfm.learned import weights
from stages.sfm.settings import SfmSettings
from stages.sfm.worker.pairs import joining_pairs, without_weaker
from tests.sfm.checks import bad_captures
from tests.sfm.truth import TRUTH, centres, similarity

needs_weights = pytest.mark.skipif(
    not weights.installed(), reason=f"no learned features: {weights.INSTALL}"
)
GAPS = 3  # every third photograph of the sample: 30 degrees from one to the next
LARGEST_ERROR_M = 0.02  # of cameras 1.4 m from the scene; a wrong join is off by decimetres


def photograph() -> np.ndarray:
    return cv2.cvtColor(bad_captures.pictures(1)[0], cv2.COLOR_BGR2GRAY)


def without_weights(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(weights, "_PACKAGE", "no_such_package_anywhere")


def test_a_photograph_is_paired_with_those_that_look_like_it_and_they_with_their_neighbours() -> (
    None
):
    likeness = np.zeros((5, 5), np.int32)
    likeness[4, 1] = likeness[1, 4] = 7
    likeness[4, 3] = likeness[3, 4] = 9
    inliers = {(0, 1): 200, (0, 2): 90, (1, 2): 12, (3, 4): 80}
    # 3 and 4 are linked by SIFT already; 0 and 1 hold the points that 4 is registered by.
    assert joining_pairs(likeness, inliers, [4]) == [(0, 1), (1, 4), (3, 4)]
    assert joining_pairs(likeness, inliers, []) == []


def test_a_pair_of_learned_features_is_dropped_where_stronger_pairs_link_its_photographs() -> None:
    inliers = {(0, 1): 60, (1, 2): 50, (0, 2): 40, (2, 3): 35}
    assert without_weaker(inliers, [(0, 2), (2, 3)]) == {(0, 2)}
    assert without_weaker(inliers, []) == set()
    assert without_weaker(inliers | {(0, 2): 55}, [(0, 2), (1, 2)]) == {(1, 2)}
    assert without_weaker({}, []) == set()


def test_without_the_extra_a_request_is_a_warning_and_sift_goes_on(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    without_weights(monkeypatch)
    report = Report()
    assert sfm.usable_features("learned", report) == "sift"
    (warning,) = report.warnings
    assert warning[0] == "sfm-learned-not-installed"
    assert 'pip install "splatcli[learned]"' in warning[1]
    assert "\n" not in warning[1]
    assert sfm.usable_features("auto", report) == "sift"
    assert len(report.warnings) == 1


def test_without_the_extra_the_error_about_photographs_left_out_names_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    without_weights(monkeypatch)
    left_out = SplatError("sfm-too-few-registered", given="G.", wanted="W.", hint="H.")
    assert 'pip install "splatcli[learned]"' in acceptance.with_hint(left_out, "auto").hint
    assert acceptance.with_hint(left_out, "sift").hint == "H."
    moving = SplatError("sfm-no-parallax", given="G.", wanted="W.", hint="H.")
    assert acceptance.with_hint(moving, "auto").hint == "H."


@needs_weights
def test_a_photograph_has_the_same_features_each_time_and_none_outside_its_mask() -> None:
    from stages.sfm.learned.features import XFeat

    network, picture = XFeat(), photograph()
    first, second = network.features(picture), network.features(picture)
    assert len(first.points) > 500
    assert first.points.tobytes() == second.points.tobytes()
    assert first.descriptors.numpy().tobytes() == second.descriptors.numpy().tobytes()
    mask = np.zeros_like(picture)
    mask[:, 320:] = 255
    right = network.features(picture, mask)
    assert len(right.points) > 100
    assert right.points[:, 0].min() > 320


@needs_weights
def test_a_blank_picture_has_no_features_and_no_matches() -> None:
    from stages.sfm.learned.features import XFeat, mutual_nearest
    from stages.sfm.learned.matching import LighterGlue

    network = XFeat()
    blank, picture = network.features(np.full((480, 640), 128, np.uint8)), None
    picture = network.features(photograph())
    assert len(blank.points) == 0
    assert LighterGlue().matches(blank, picture).shape == (0, 2)
    assert mutual_nearest(blank, picture, 512, 0.8) == 0


@needs_weights
def test_a_warped_photograph_matches_where_it_was_warped_to() -> None:
    from stages.sfm.learned.features import XFeat
    from stages.sfm.learned.matching import LighterGlue

    picture = photograph()
    warp = np.array([[0.9, 0.12, 20.0], [-0.1, 0.85, 50.0], [1e-4, 5e-5, 1.0]])
    warped = cv2.warpPerspective(picture, warp, (640, 480))
    network = XFeat()
    first, second = network.features(picture), network.features(np.asarray(warped, np.uint8))
    matches = LighterGlue().matches(first, second)
    assert len(matches) > 300
    assert len(np.unique(matches[:, 0])) == len(np.unique(matches[:, 1])) == len(matches)
    at = np.c_[first.points[matches[:, 0]] - 0.5, np.ones(len(matches))] @ warp.T
    away = np.linalg.norm(at[:, :2] / at[:, 2:] + 0.5 - second.points[matches[:, 1]], axis=1)
    assert np.median(away) < 1.0  # keypoints are whole pixels in both
    assert (away < 3.0).mean() > 0.95


@needs_weights
@pytest.mark.slow
@pytest.mark.timeout(600)
def test_learned_features_join_photographs_that_sift_leaves_in_pieces(tmp_path: Path) -> None:
    photographs = tmp_path / "photographs"
    photographs.mkdir()
    for path in sorted(bad_captures.SAMPLE.glob("*.jpg"))[::GAPS]:
        shutil.copy(path, photographs)
    capture = ingest.run({"photos": photographs}, IngestSettings(), tmp_path / "1-ingest", Report())
    settings, report = SfmSettings(), Report()
    found = sfm.run({"ingest": capture}, settings, tmp_path / "2-sfm", report)
    assert len(found.views) == len(capture.photos)
    sift, joined = report.metrics["registered_by"].values()
    assert sift + len(joined) == len(capture.photos)
    assert joined, "SIFT alone must leave some out"
    assert [attempt["configuration"] for attempt in report.metrics["attempts"]] == [
        "standard",
        "learned features",
    ]
    truth = {p["name"]: p["world_to_camera"] for p in json.loads(TRUTH.read_text())["photos"]}
    true = centres(np.array([truth[view.name] for view in found.views]))
    own = centres(np.array([view.camera.world_to_camera for view in found.views], np.float64))
    turn, scale, shift = similarity(own, true)
    assert np.linalg.norm(scale * own @ turn.T + shift - true, axis=1).max() < LARGEST_ERROR_M
