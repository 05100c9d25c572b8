"""Gates: the bad captures that were measured are caught, the good ones pass."""

from __future__ import annotations

from dataclasses import replace

import pytest

from stages.sfm.checks.gates import (
    CALIBRATED,
    CONTRADICTED_SHARE,
    PANORAMIC,
    PLANAR,
    ModelStatistics,
    borderline_failures,
    check_keypoints,
    check_model,
    check_pairs,
    connected_groups,
    contradicted,
)

# Measured with pycolmap 4.2.1 on photographs 1600 px wide.
BANANA = ModelStatistics(
    photographs=16,
    registered=15,
    models=(15,),
    points=7133,
    mean_reprojection_error_px=0.34,
    long_side_px=1600,
    mean_track_length=3.6,
    median_triangulation_angle_deg=16.5,
    baseline_over_depth=1.63,
    distortion=0.0098,
    focal_over_prior=1.04,
    pairs_checked=40,
    cut_points=500,
    cut_views=3,
)
PLUSH = replace(
    BANANA,
    photographs=97,
    registered=97,
    models=(97,),
    points=24619,
    mean_reprojection_error_px=1.02,
)
DRONE = replace(BANANA, median_triangulation_angle_deg=5.0, baseline_over_depth=0.4)


def codes(statistics: ModelStatistics) -> list[str]:
    return [failure.code for failure in check_model(statistics)]


@pytest.mark.parametrize("statistics", [BANANA, PLUSH, DRONE], ids=["banana", "plush", "drone"])
def test_good_captures_pass(statistics: ModelStatistics) -> None:
    assert codes(statistics) == []


@pytest.mark.parametrize(
    ("changes", "code"),
    [
        # two scenes in one folder: models of 15 and 11
        ({"photographs": 26, "registered": 15, "models": (15, 11)}, "sfm-too-few-registered"),
        # pure rotation, incremental: 7 of 20 registered, no points
        (
            {"photographs": 20, "registered": 7, "models": (7,), "points": 0},
            "sfm-no-parallax",
        ),
        # pure rotation, by COLMAP's global mapper: everything registered, 0.22 px, 2.2 degrees
        (
            {
                "photographs": 20,
                "registered": 20,
                "mean_reprojection_error_px": 0.22,
                "median_triangulation_angle_deg": 2.2,
            },
            "sfm-no-parallax",
        ),
        # zoom only: everything registered at 0.17 px, the camera never moved
        ({"photographs": 16, "registered": 16, "baseline_over_depth": 0.01}, "sfm-no-parallax"),
        # zoom to a half, incremental: 16 of 16 at 0.07 px and 5 degrees, as towards a poster
        ({"flatness": 0.03, "sideways_share": 0.03}, "sfm-no-parallax"),
        # near-duplicates, darkness: nothing
        ({"registered": 0, "models": (), "points": 0}, "sfm-no-model"),
        # strong blur: 2 registered
        ({"registered": 2, "models": (2,), "points": 40}, "sfm-no-model"),
        # blank wall: 20 of 20 at 0.13 px with 301 points
        (
            {"photographs": 20, "registered": 20, "points": 301},
            "sfm-too-few-points",
        ),
        # date stamp: focal 2693 for 694, k = -8.6
        ({"distortion": -8.6, "focal_over_prior": 2693 / 694}, "sfm-implausible-distortion"),
        ({"focal_over_prior": 2693 / 694}, "sfm-implausible-focal"),
        ({"focal_over_prior": 694 / 2693}, "sfm-implausible-focal"),
        # forward motion along a street: 2 of 29, k = 5.8
        (
            {"photographs": 29, "registered": 2, "models": (2,), "distortion": 5.8, "points": 90},
            "sfm-no-model",
        ),
        # an object turned over half-way: 36 of 193 pairs, everything else plausible
        (
            {"pairs_checked": 193, "pairs_inconsistent": 36, "inconsistent_pair": ("a", "b")},
            "sfm-contradictions",
        ),
        # the same poster on opposite walls: walls put into one, but not by those between them
        ({"rotation_to_other_deg": 175.0}, "sfm-contradictions"),
        # two halves that one pair links, put beside each other by COLMAP's global mapper
        ({"cut_points": 1, "cut_views": 8}, "sfm-weak-link"),
        ({"cut_points": 20, "cut_views": 8}, "sfm-weak-link"),
        ({"mean_reprojection_error_px": 2.6}, "sfm-high-error"),
        ({"mean_reprojection_error_px": float("nan")}, "sfm-high-error"),
        ({"timed_out": True}, "sfm-timed-out"),
    ],
)
def test_measured_bad_captures_are_caught(changes: dict[str, object], code: str) -> None:
    assert code in codes(replace(BANANA, **changes))  # type: ignore[arg-type]


def test_a_focal_length_off_its_prior_is_not_put_down_to_a_date_stamp() -> None:
    (failure,) = check_model(replace(BANANA, focal_over_prior=0.48))
    assert failure.code == "sfm-implausible-focal"
    assert "date stamp" not in failure.hint
    assert "--max-side" in failure.hint


def test_one_photograph_of_sixteen_may_be_left_out_but_not_four() -> None:
    assert codes(BANANA) == []
    assert codes(replace(BANANA, registered=12)) == ["sfm-too-few-registered"]


@pytest.mark.parametrize("other", [{"flatness": 0.3}, {"sideways_share": 0.3}])
def test_a_flat_scene_and_a_walk_straight_on_pass_each_alone(other: dict[str, float]) -> None:
    zoom = replace(BANANA, flatness=0.03, sideways_share=0.03)
    assert codes(replace(zoom, **other)) == []  # type: ignore[arg-type]


def test_a_few_inconsistent_pairs_are_accepted() -> None:
    assert codes(replace(BANANA, pairs_checked=8, pairs_inconsistent=2)) == []
    assert codes(replace(PLUSH, pairs_checked=1200, pairs_inconsistent=60)) == []


def test_borderline_models_get_a_warning() -> None:
    assert borderline_failures(PLUSH) == []
    few = replace(PLUSH, pairs_checked=100, pairs_inconsistent=5, inconsistent_pair=("a", "b"))
    assert codes(few) == []
    assert contradicted(few, CONTRADICTED_SHARE)  # training decides
    assert not contradicted(PLUSH, CONTRADICTED_SHARE)
    loose = replace(PLUSH, cut_points=60, cut_views=12)
    assert codes(loose) == []
    assert [failure.code for failure in borderline_failures(loose)] == ["sfm-weak-link"]


def test_error_limit_grows_with_the_photographs() -> None:
    coarse = replace(BANANA, mean_reprojection_error_px=3.5)
    assert codes(coarse) == ["sfm-high-error"]
    assert codes(replace(coarse, long_side_px=4000)) == []


@pytest.mark.parametrize(
    ("counts", "passes"),
    [
        ([76] * 20, False),
        ([257] * 20, True),
        ([], False),
        ([0] * 6, False),
        ([9000] * 9 + [0], True),
    ],
)
def test_strong_blur_has_too_few_keypoints_and_mild_blur_has_not(
    counts: list[int], passes: bool
) -> None:
    assert (check_keypoints(counts) == []) == passes


def chain(count: int, config: int = CALIBRATED) -> list[tuple[int, int, int, int]]:
    return [(i, i + 1, 100, config) for i in range(count - 1)]


def test_panoramic_pairs_have_no_parallax_but_planar_pairs_are_fine() -> None:
    assert [f.code for f in check_pairs(chain(10, PANORAMIC), 10)] == ["sfm-no-parallax"]
    assert check_pairs(chain(10, PLANAR), 10) == []
    assert check_pairs(chain(10), 10) == []


def test_unconnected_groups_are_named_by_size() -> None:
    pairs = [*chain(6), (6, 7, 50, CALIBRATED)]
    assert connected_groups(pairs, 9) == [[0, 1, 2, 3, 4, 5], [6, 7], [8]]
    (failure,) = check_pairs(pairs, 9)
    assert failure.code == "sfm-separate-groups"
    assert "6, 2" in failure.given
    assert "1 photograph matches no other" in failure.given


def test_no_pairs_at_all() -> None:
    assert [f.code for f in check_pairs([], 4)] == ["sfm-no-matches"]


def test_every_failure_is_three_plain_sentences() -> None:
    bad = replace(
        BANANA,
        registered=4,
        points=3,
        distortion=2.0,
        focal_over_prior=5.0,
        mean_reprojection_error_px=9.0,
    )
    failures = check_model(bad)
    assert len(failures) == 5
    for failure in failures:
        assert failure.code.startswith("sfm-")
        for text in (failure.given, failure.wanted, failure.hint):
            assert text[0].isupper() or text[0].isdigit()
            assert text.endswith(".")
