"""One evaluation for all stages: the same figures for the same scene in any unit."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from stages.base.stage import Report
from stages.evaluate import evaluation
from stages.evaluate.evaluation import (
    LARGEST_SUBSET,
    EvaluationView,
    evaluate,
    evaluate_at_sizes,
    evaluation_subset,
    image_renderer,
    load_evaluation_views,
    mean_psnr_db,
    psnr_of_views_db,
)
from stages.evaluate.image_metrics import IDENTICAL_DB, capped_psnr_db, flip
from stages.raster.draw import raster_settings_of
from stages.scene import (
    IGNORE,
    TRANSPARENT,
    Camera,
    DrawSettings,
    Reconstruction,
    Splats,
    View,
    draw_settings_of,
)
from stages.train.quality import _report_scores, write_quality
from tests.scenes import BACKENDS, join, splats
from tests.small_scene import SmallScene, small_scene


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> SmallScene:
    return small_scene(tmp_path_factory.mktemp("photographs"), views=5, n=120)


def in_units(scene: SmallScene, factor: float) -> tuple[Splats, Reconstruction]:
    """The same scene and cameras, all lengths times `factor`."""
    views = []
    for view in scene.reconstruction.views:
        matrix = view.camera.world_to_camera.copy()
        matrix[:3, 3] *= factor
        views.append(View(view.name, view.image, replace(view.camera, world_to_camera=matrix)))
    found = scene.splats
    points = scene.reconstruction.points * factor
    enlarged = replace(scene.reconstruction, views=tuple(views), points=points)
    larger = replace(
        found,
        means=found.means * np.float32(factor),
        log_scales=found.log_scales + np.float32(np.log(factor)),
        draw_settings=draw_settings_of(enlarged, 72),
    )
    return larger, enlarged


@pytest.mark.parametrize("factor", [1e-4, 1e4])
@pytest.mark.parametrize("backend", BACKENDS)
def test_a_scene_in_other_units_gets_the_same_figures(
    scene: SmallScene, backend: str, factor: float
) -> None:
    figures = []
    for units in (1.0, factor):
        trained, reconstruction = in_units(scene, units)
        photographs = load_evaluation_views(
            reconstruction.folder, reconstruction.views, trained.draw_settings
        )
        figures.append(evaluate(image_renderer(trained, backend), photographs))
    for one, other in zip(*figures, strict=True):
        assert one.psnr_db == pytest.approx(other.psnr_db, abs=0.01)
        assert one.ssim == pytest.approx(other.ssim, abs=1e-3)


def test_a_file_without_cameras_gets_a_near_plane_of_its_own_size(scene: SmallScene) -> None:
    """In small units nothing is clipped, in large ones what hangs before the lens is."""
    for factor in (1e-4, 1.0, 1e4):
        alone = replace(in_units(scene, factor)[0], draw_settings=DrawSettings())
        extent = float(np.ptp(alone.means, axis=0).max())
        assert 1e-4 * extent < raster_settings_of(alone).near < 0.02 * extent


def test_views_are_compared_at_the_size_of_training(scene: SmallScene) -> None:
    views, folder = scene.reconstruction.views, scene.reconstruction.folder
    (small, *_) = load_evaluation_views(folder, views, DrawSettings(0.01, 36))
    assert small.pixels.shape == (27, 36, 3)
    (full, *_) = load_evaluation_views(folder, views, DrawSettings(0.01))
    with Image.open(Path(folder) / views[0].image) as picture:
        np.testing.assert_array_equal(full.pixels, np.asarray(picture))


def test_a_scaled_view_is_the_photograph_at_that_size(scene: SmallScene) -> None:
    """Area means of area means: but for the rounding of the first, what `load_image` gives."""
    views, folder = scene.reconstruction.views, scene.reconstruction.folder
    (full, *_) = load_evaluation_views(folder, views, DrawSettings(0.01))
    for scale, side in ((0.5, 36), (0.25, 18)):
        (small, *_) = load_evaluation_views(folder, views, DrawSettings(0.01, side))
        found = full.scaled(scale)
        assert (found.camera.width, found.camera.height) == (
            small.camera.width,
            small.camera.height,
        )
        assert found.camera.fx == pytest.approx(small.camera.fx)
        assert np.abs(found.pixels.astype(int) - small.pixels).max() <= 1


def test_a_pixel_counts_at_a_smaller_size_if_all_that_it_averages_counts() -> None:
    camera = Camera(8, 8, 10.0, 10.0, 4.0, 4.0, np.eye(4))
    mask, excluded = np.full((8, 8), 255, np.uint8), np.zeros((8, 8), bool)
    mask[0, 1], excluded[7, 7] = 0, True
    view = EvaluationView("a", camera, np.zeros((8, 8, 3), np.uint8), mask, IGNORE, excluded)
    wanted = np.ones((4, 4), bool)
    wanted[0, 0] = wanted[3, 3] = False
    np.testing.assert_array_equal(view.scaled(0.5).valid, wanted)


def test_views_of_two_sizes_are_compared_on_pixels_that_are_valid_in_both() -> None:
    camera = Camera(4, 4, 5.0, 5.0, 2.0, 2.0, np.eye(4))
    view = EvaluationView("a", camera, np.zeros((4, 4, 3), np.uint8))
    assert view.compared_within(None).valid is None
    valid = np.ones((8, 8), bool)
    valid[0, 1] = False
    wanted = np.ones((4, 4), bool)
    wanted[0, 0] = False
    first = view.compared_within(valid)
    np.testing.assert_array_equal(first.valid, wanted)
    second = np.ones((4, 4), bool)
    second[3, 3] = wanted[3, 3] = False
    np.testing.assert_array_equal(first.compared_within(second).valid, wanted)


def test_an_evaluation_at_sizes_draws_each_size_and_begins_with_the_full_one(
    scene: SmallScene,
) -> None:
    views = load_evaluation_views(
        scene.reconstruction.folder, scene.reconstruction.views, scene.splats.draw_settings
    )
    draw = image_renderer(scene.splats, "cpu")
    found = evaluate_at_sizes(draw, views, with_flip=True)
    assert list(found) == ["full", "half", "quarter"]
    assert found["full"] == evaluate(draw, views, with_flip=True)
    for name, scale in (("half", 0.5), ("quarter", 0.25)):
        assert found[name] == evaluate(draw, [view.scaled(scale) for view in views])


def with_sparse_masks(scene: SmallScene, folder: Path) -> Sequence[EvaluationView]:
    """The views, two of them with masks. That of the first is empty. That of the second keeps every
    other column, so that no pixel is left at half size."""
    nothing, stripes = np.zeros((54, 72), np.uint8), np.zeros((54, 72), np.uint8)
    stripes[:, ::2] = 255
    first, second, *others = scene.reconstruction.views
    for name, mask in (("nothing.png", nothing), ("stripes.png", stripes)):
        Image.fromarray(mask).save(folder / name)
    masked = (
        replace(first, mask=str(folder / "nothing.png"), outside=IGNORE),
        replace(second, mask=str(folder / "stripes.png"), outside=IGNORE),
    )
    settings = scene.splats.draw_settings
    return load_evaluation_views(scene.reconstruction.folder, (*masked, *others), settings)


@pytest.mark.filterwarnings("error")
def test_a_view_without_a_pixel_that_counts_is_in_no_mean(
    scene: SmallScene, tmp_path: Path
) -> None:
    views = with_sparse_masks(scene, tmp_path)
    found = evaluate_at_sizes(image_renderer(scene.splats, "cpu"), views)
    counts = {name: [score.counts for score in scores] for name, scores in found.items()}
    assert counts == {
        "full": [False, True, True, True, True],
        "half": [False, False, True, True, True],
        "quarter": [False, False, True, True, True],
    }
    of_views = psnr_of_views_db(scene.splats, views, "cpu")
    assert np.isnan(of_views).tolist() == [True, False, False, False, False]
    for scale, first in ((1.0, 1), (0.5, 2), (0.25, 2)):
        mean = mean_psnr_db(scene.splats, views, "cpu", scale)
        assert mean == mean_psnr_db(scene.splats, views[first:], "cpu", scale)
    report, reconstruction = Report(), scene.reconstruction
    settings = scene.splats.draw_settings
    draw = image_renderer(scene.splats, "cpu")
    write_quality(draw, views, settings, reconstruction, tmp_path, report)
    names = [view.name for view in reconstruction.views]
    assert [score["name"] for score in report.metrics["held_out"]] == names[1:]
    assert report.metrics["psnr_half_db"] > 20
    assert report.metrics["psnr_worst_db"] > 20
    assert not report.warnings


def test_where_masks_leave_nothing_quality_is_not_measured(
    scene: SmallScene, tmp_path: Path
) -> None:
    views, report = with_sparse_masks(scene, tmp_path)[:1], Report()
    assert mean_psnr_db(scene.splats, views, "cpu") == 0
    settings = scene.splats.draw_settings
    draw = image_renderer(scene.splats, "cpu")
    write_quality(draw, views, settings, scene.reconstruction, tmp_path, report)
    [(code, message)] = report.warnings
    assert code == "train-nothing-held-out"
    assert "Masks" in message
    assert "psnr_db" not in report.metrics


def test_a_python_without_flip_evaluates_without_it(
    scene: SmallScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "flip_evaluator", None)
    monkeypatch.setattr("stages.evaluate.image_metrics.find_spec", lambda name: None)
    views = load_evaluation_views(
        scene.reconstruction.folder, scene.reconstruction.views[:1], scene.splats.draw_settings
    )
    (score,) = evaluate(image_renderer(scene.splats, "cpu"), views, with_flip=True)
    assert score.flip is None
    report = Report()
    _report_scores({"full": [score]}, report)
    assert "flip" not in report.metrics
    assert report.metrics["ssim"] > 0


def test_the_near_plane_of_the_look_decides_what_is_drawn() -> None:
    before_the_lens = splats([[0.0, 0.0, 0.5]], rgb=(1.0, 0.0, 0.0))
    both = join(before_the_lens, splats([[0.0, 0.0, 5.0]], rgb=(0.0, 1.0, 0.0)))
    assert raster_settings_of(replace(both, draw_settings=DrawSettings(near=1.0))).near == 1.0


def test_figures_stay_finite() -> None:
    white = np.ones((4, 4, 3), np.float32)
    assert capped_psnr_db(white, white) == IDENTICAL_DB
    assert capped_psnr_db(white * np.nan, white) == 0.0
    assert capped_psnr_db(white * 7, white) == IDENTICAL_DB  # a screen shows no more than white


def test_flip_is_that_of_its_authors_worked_cases() -> None:
    """0 for equal pictures; nearly 1 for blue against yellow, which are as far apart as the
    measure's colours go; and one noisy pixel in a thousand hardly counts."""
    blue = np.zeros((32, 32, 3), np.float32) + np.array([0, 0, 1], np.float32)
    yellow = 1 - blue
    assert flip(blue, blue) == 0.0
    assert flip(blue, yellow) > 0.9
    speck = blue.copy()
    speck[16, 16] = 1.0
    assert 0.0 < flip(speck, blue) < 0.05


def with_masks(scene: SmallScene, folder: Path, outside: str) -> tuple[View, ...]:
    """The scene's views, each with its right half masked."""
    mask = np.repeat(np.array([255, 0], np.uint8), 36)[None] * np.ones((54, 1), np.uint8)
    for view in scene.reconstruction.views:
        Image.fromarray(mask).save(folder / f"{view.name}.mask.png")
    return tuple(
        replace(view, mask=f"{view.name}.mask.png", outside=outside)
        for view in scene.reconstruction.views
    )


def test_ignored_pixels_are_not_compared(scene: SmallScene) -> None:
    folder = scene.reconstruction.folder
    views = with_masks(scene, folder, IGNORE)
    (photograph, *_) = load_evaluation_views(folder, views, DrawSettings(0.01))
    wrong = photograph.image.copy()
    wrong[:, 36:] = 1 - wrong[:, 36:]
    (score,) = evaluate(lambda _: wrong, [photograph], with_flip=True)
    assert score.psnr_db == IDENTICAL_DB
    assert score.ssim == pytest.approx(1)
    assert score.flip == pytest.approx(0)
    (score,) = evaluate(lambda _: photograph.image + 0.1, [photograph])
    assert 19.9 < score.psnr_db < 20.5  # but for what is clipped


def test_transparent_photographs_are_compared_over_white_and_must_be_empty_outside(
    scene: SmallScene,
) -> None:
    folder = scene.reconstruction.folder
    views = with_masks(scene, folder, TRANSPARENT)
    draw_settings = draw_settings_of(replace(scene.reconstruction, views=views))
    (photograph, *_) = load_evaluation_views(folder, views, draw_settings)
    assert draw_settings.background == 1.0
    assert photograph.pixels[:, 36:].min() == 255
    assert raster_settings_of(replace(scene.splats, draw_settings=draw_settings)).background == (
        1.0,
        1.0,
        1.0,
    )
    (score,) = evaluate(lambda _: photograph.image * (np.arange(72) < 36)[:, None], [photograph])
    assert score.psnr_db < 4


def test_photographs_that_do_not_fit_into_memory_get_the_same_scores(
    scene: SmallScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, views = scene.reconstruction.folder, scene.reconstruction.views
    figures = []
    for most in (evaluation.IN_MEMORY_MIB, 0.01, 0.0):
        monkeypatch.setattr(evaluation, "IN_MEMORY_MIB", most)
        photographs = load_evaluation_views(folder, views, scene.splats.draw_settings)
        assert len(photographs) == len(views)
        assert [p.name for p in photographs] == [view.name for view in views]
        assert (photographs[-1].pixels == list(photographs)[-1].pixels).all()
        figures.append(evaluate(image_renderer(scene.splats, "cpu"), photographs))
    assert figures[0] == figures[1] == figures[2]


@pytest.mark.parametrize("count", [0, 1, 24, 25, 200, 1000])
def test_the_subset_of_many_views_is_small_and_evenly_spaced(count: int) -> None:
    chosen = evaluation_subset(count)
    assert min(count, LARGEST_SUBSET // 2) <= len(chosen) <= LARGEST_SUBSET
    assert count > LARGEST_SUBSET or list(chosen) == list(range(count))
    assert not count or count - chosen[-1] <= chosen.step


def test_flip_is_computed_for_the_subset_and_psnr_for_all() -> None:
    camera = Camera(16, 16, 20.0, 20.0, 8.0, 8.0, np.eye(4))
    shown = EvaluationView("a", camera, np.full((16, 16, 3), 99, np.uint8))
    found = evaluate(lambda _: shown.image, [shown] * 50, with_flip=True)
    assert len(found) == 50
    assert [i for i, score in enumerate(found) if score.flip is not None] == list(
        evaluation_subset(50)
    )
