"""Statistics of a model whose every number is known."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stages.sfm.checks.statistics import (
    flatness,
    model_statistics,
    sideways_share,
    triangulation_angles,
)
from stages.sfm.worker.sparse_model import (
    MappingResult,
    SparseModel,
    load_result,
    reprojection_errors,
    save_model,
    without_implausible_views,
)
from tests.sfm.synthetic import orbit_model


def test_exact_observations_have_no_error_and_a_shift_is_measured_in_pixels() -> None:
    model = orbit_model(views=6, points=50)
    assert reprojection_errors(model).max() < 1e-9
    shifted = replace(model, observed_px=model.observed_px + np.array([3.0, 4.0]))
    assert np.allclose(reprojection_errors(shifted), 5.0)


def test_points_behind_a_camera_have_infinite_error() -> None:
    model = orbit_model(views=4, points=5)
    behind = replace(model, points=model.points + 100 * model.centres[0])
    assert np.isinf(reprojection_errors(behind)).any()


def test_figures_of_a_half_circle() -> None:
    model = orbit_model(views=7, points=200)
    result = MappingResult(model, (model.names,), timed_out=False)
    statistics = model_statistics(result, 8)
    assert (statistics.photographs, statistics.registered, statistics.points) == (8, 7, 200)
    assert statistics.mean_track_length == 7
    # Opposite ends, 4 away and 1 up: 2 atan(4) = 152 degrees in the middle, less around it.
    assert statistics.median_triangulation_angle_deg == pytest.approx(152.0, abs=6)
    assert statistics.focal_over_prior == pytest.approx(1.05)
    assert statistics.distortion == -0.05
    assert (statistics.pairs_checked, statistics.pairs_inconsistent) == (6, 0)
    assert (statistics.cut_points, statistics.cut_views) == (200, 3)


def test_a_poster_is_flat_and_a_step_towards_it_is_not_sideways() -> None:
    model = orbit_model(views=6, points=200)
    poses = np.repeat(model.world_to_camera[:1], 6, axis=0)
    poses[:, 2, 3] -= 0.3 * np.arange(6)  # closer along the optical axis
    straight = replace(model, world_to_camera=poses, points=model.points * [1, 1, 0.02])
    assert flatness(straight.points) == pytest.approx(0.02, rel=0.3)
    assert sideways_share(straight) < 1e-6
    assert flatness(model.points) > 0.8
    assert 0.5 < sideways_share(model) <= 1.0


def test_inconsistent_pairs_are_counted_and_one_is_named() -> None:
    model = orbit_model(views=6, points=40)
    fits = np.array([0.9, 0.5, 0.1, 1.0, 0.0])
    result = MappingResult(replace(model, pair_inlier_ratios=fits), (model.names,), timed_out=False)
    statistics = model_statistics(result, 6)
    assert statistics.pairs_inconsistent == 2
    assert statistics.inconsistent_pair == ("02.jpg", "03.jpg")
    assert statistics.pairs_turned == 0
    turned = np.array([True, False, True, False, False])
    both = replace(model, pair_inlier_ratios=fits, pairs_turned=turned)
    statistics = model_statistics(replace(result, model=both), 6)
    assert (statistics.pairs_inconsistent, statistics.pairs_turned) == (3, 1)
    faces = tuple(f"photos/{i}.jpg/000+25.jpg" for i in range(6))
    named = replace(result.model, names=faces) if result.model else None
    statistics = model_statistics(replace(result, model=named), 6)
    assert statistics.inconsistent_pair == ("2.jpg/000+25.jpg", "3.jpg/000+25.jpg")


def test_cameras_in_one_place_have_no_baseline_and_no_angle() -> None:
    model = orbit_model(views=6, points=40)
    poses = model.world_to_camera.copy()
    centre = model.centres[0]
    poses[:, :3, 3] = -np.einsum("vij,j->vi", poses[:, :3, :3], centre)
    still = replace(model, world_to_camera=poses)
    assert triangulation_angles(still, np.arange(40)).max() < 1e-5
    statistics = model_statistics(MappingResult(still, (model.names,), timed_out=False), 6)
    assert statistics.baseline_over_depth < 1e-9


def test_views_with_hardly_any_points_go_and_the_rest_stays_consistent() -> None:
    model = orbit_model(views=6, points=100)
    # View 2 sees points 0-9 only; points 90-99 are seen by views 2 and 5 only... and so by one.
    keep = (model.observing_views != 2) | (model.observed_points < 10)
    keep &= (model.observed_points < 90) | (model.observing_views == 5)
    thin = replace(
        model,
        observed_points=model.observed_points[keep],
        observing_views=model.observing_views[keep],
        observed_px=model.observed_px[keep],
    )
    kept = without_implausible_views(thin)
    assert kept.names == ("00.jpg", "01.jpg", "03.jpg", "04.jpg", "05.jpg")
    assert len(kept.points) == 90
    assert reprojection_errors(kept).max() < 1e-9
    assert (kept.tracks == 5).all()
    assert kept.pairs.max() == 4
    assert without_implausible_views(model) is model


def two_cameras(views: int, odd: int, k: float) -> SparseModel:
    """The last `odd` views have a camera of their own with distortion k."""
    model = orbit_model(views=views, points=40)
    return replace(
        model,
        view_cameras=(np.arange(views) >= views - odd).astype(np.int32),
        camera_sizes=np.repeat(model.camera_sizes, 2, axis=0),
        camera_params=np.array([model.camera_params[0], [*model.camera_params[0, :3], k]]),
        focal_priors_px=np.repeat(model.focal_priors_px, 2),
    )


def test_one_photograph_with_an_absurd_lens_goes_and_many_are_left_for_the_gates() -> None:
    one = without_implausible_views(two_cameras(12, 1, k=-3.0))
    assert len(one.names) == 11
    assert len(one.camera_params) == 1
    assert one.view_cameras.max() == 0
    assert len(without_implausible_views(two_cameras(12, 1, k=0.1)).names) == 12
    many = without_implausible_views(two_cameras(12, 4, k=-3.0))
    assert len(many.names) == 12
    assert model_statistics(MappingResult(many, (many.names,), False), 12).distortion == -3.0


def test_a_saved_result_comes_back_equal(tmp_path: Path) -> None:
    model = orbit_model(views=3, points=20)
    save_model(tmp_path / "m", model, groups=[["a", "ü"], ["b"]], timed_out=True)
    result = load_result(tmp_path / "m")
    assert result.groups == (("a", "ü"), ("b",))
    assert result.timed_out
    assert result.model is not None
    assert result.model.names == model.names
    assert (result.model.observed_px == model.observed_px).all()


def test_nothing_found_is_a_result_too(tmp_path: Path) -> None:
    save_model(tmp_path / "m", None, groups=[], timed_out=False)
    result = load_result(tmp_path / "m")
    assert result.model is None
    assert model_statistics(result, 5).registered == 0
