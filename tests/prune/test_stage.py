"""Pruning removes floaters and splats that contribute little; the pictures stay."""

import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from stages import formats
from stages.base.errors import Interrupted, SplatError
from stages.base.stage import Report
from stages.evaluate import contribution, evaluation
from stages.evaluate.contribution import Contributions, near_view_frusta
from stages.evaluate.evaluation import load_evaluation_views, mean_psnr_db
from stages.evaluate.floaters import near_camera_floaters
from stages.evaluate.selection import RemovalLimits, select_removal
from stages.prune import rounds as pruning
from stages.prune import stage as prune
from stages.prune.settings import PruneSettings
from stages.raster.draw import render
from stages.scene import IGNORE, Splats, TrainedSplats, View, split_held_out
from tests.scenes import camera, join, splats
from tests.small_scene import SmallScene, small_scene


def floater_before(scene: SmallScene, view: int, distance: float = 0.4) -> Splats:
    """A grey splat close before one camera, that hides a part of its picture."""
    at = scene.reconstruction.views[view].camera
    return splats(at.centre + distance * at.forward, scales=0.03, opacities=0.9, rgb=(0.5,) * 3)


def unseen(n: int) -> Splats:
    """Splats far above all cameras, which look down a little."""
    means = np.stack([np.linspace(-1, 1, n), np.full(n, -50.0), np.zeros(n)], 1)
    return splats(means, scales=0.05)


def run(scene: SmallScene, trained: Splats, folder: Path, **settings) -> tuple[Splats, Report]:
    """Without fine-tuning unless it is asked for: splats that stay are then the same."""
    report = Report()
    inputs = {"sfm": scene.reconstruction, "train": TrainedSplats(trained)}
    wanted = PruneSettings(**{"finetune_steps": 0, **settings})
    return prune.run(inputs, wanted, folder, report).splats, report


def rows_of(part: Splats, whole: Splats) -> np.ndarray:
    """[len(part)] whether each of its splats is (still) in `whole`."""
    return (part.means[:, None] == whole.means[None]).all(2).any(1)


def training_db(scene: SmallScene, found: Splats) -> float:
    training, _ = split_held_out(scene.reconstruction.views)
    photographs = load_evaluation_views(scene.reconstruction.folder, training, found.draw_settings)
    return mean_psnr_db(found, photographs, "cpu")


def showing(scene: SmallScene, trained: Splats, views: Sequence[View], folder: Path) -> SmallScene:
    """The scene with photographs in `folder`, of which these views show `trained`."""
    reconstruction = scene.reconstruction
    shutil.copytree(reconstruction.folder, folder)
    for view in views:
        image = render(trained, view.camera).image
        Image.fromarray(np.uint8(image.clip(0, 1) * 255 + 0.5)).save(folder / view.image)
    return replace(scene, reconstruction=replace(reconstruction, folder=folder))


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> SmallScene:
    return small_scene(tmp_path_factory.mktemp("photographs"))


@pytest.mark.parametrize("drawn", [1, 2, 9])
def test_stopping_is_heeded_before_the_next_view(scene, tmp_path, monkeypatch, drawn: int) -> None:
    """Two views are held out, and drawn first; with many views each pass takes long."""
    report, scored = Report(), []

    def score(*words: Any) -> float:
        scored.append(1)
        if len(scored) == drawn:
            report.stop_requested.set()
        return 20.0

    for module in (evaluation, contribution):
        monkeypatch.setattr(module, "capped_psnr_db", score)
    inputs = {"sfm": scene.reconstruction, "train": TrainedSplats(scene.splats)}
    with pytest.raises(Interrupted):
        prune.run(inputs, PruneSettings(), tmp_path, report)
    assert len(scored) == drawn


def test_a_splat_close_to_one_camera_is_removed(scene, tmp_path) -> None:
    floater = floater_before(scene, 4)  # which one other view sees from afar
    _, reference = run(scene, scene.splats, tmp_path, max_loss_db=0)
    result, report = run(scene, join(scene.splats, floater), tmp_path, max_loss_db=0)
    assert not rows_of(floater, result).any()
    assert report.metrics["floaters_removed"] > reference.metrics["floaters_removed"]
    assert report.metrics["psnr_change_db"] >= -0.05
    assert report.metrics["psnr_change_worst_view_db"] <= report.metrics["psnr_change_db"]


def test_splats_that_only_masks_ignore_are_floaters(scene, tmp_path) -> None:
    """Masks ignore the upper third of all photographs."""
    folder = shutil.copytree(scene.reconstruction.folder, tmp_path / "photographs")
    mask = np.zeros((54, 72), np.uint8)
    mask[18:] = 255
    Image.fromarray(mask).save(folder / "mask.png")
    views = tuple(
        replace(view, mask="mask.png", outside=IGNORE) for view in scene.reconstruction.views
    )
    masked = replace(
        scene, reconstruction=replace(scene.reconstruction, folder=folder, views=views)
    )
    fog = splats([[0.0, -0.9, 0.0], [0.1, -0.85, 0.1]], scales=0.03, rgb=(0.4, 0.3, 0.1))
    in_sight = splats([[0.0, 1.0, 0.0]], scales=0.03, rgb=(0.9, 0.3, 0.1))
    result, report = run(masked, join(scene.splats, fog, in_sight), tmp_path, strength=0.01)
    assert not rows_of(fog, result).any()
    assert report.metrics["floaters_removed"] >= 2
    assert rows_of(scene.splats, result).mean() > 0.5


def test_splats_that_no_view_shows_are_removed(scene, tmp_path) -> None:
    lost = unseen(12)
    result, report = run(scene, join(scene.splats, lost), tmp_path, max_loss_db=0)
    assert not rows_of(lost, result).any()
    assert report.metrics["unneeded_removed"] >= 12
    assert report.metrics["psnr_change_db"] >= -0.05
    assert report.metrics["splats_before"] == len(scene.splats) + 12
    assert report.metrics["splats"] == len(result)
    removed = report.metrics["floaters_removed"] + report.metrics["unneeded_removed"]
    assert removed == report.metrics["splats_before"] - len(result)


def test_with_no_loss_allowed_the_training_views_lose_nothing(scene, tmp_path) -> None:
    trained = join(scene.splats, floater_before(scene, 1), unseen(20))
    result, _ = run(scene, trained, tmp_path, max_loss_db=0.0)
    assert training_db(scene, result) >= training_db(scene, trained)


def test_the_loss_stays_below_what_the_strength_allows(scene, tmp_path) -> None:
    start, sizes = training_db(scene, scene.splats), []
    for strength in (1.0, 20.0):
        result, report = run(scene, scene.splats, tmp_path, strength=strength, rounds=10)
        assert training_db(scene, result) >= start - 0.1 * strength
        assert report.metrics["training_psnr_db"] == pytest.approx(
            training_db(scene, result), abs=2e-3
        )
        sizes.append(len(result))
    assert sizes[1] < sizes[0]


def test_what_costs_one_view_too_much_stays(scene, tmp_path) -> None:
    """One photograph shows a splat that counts as a floater by the others."""
    views = scene.reconstruction.views
    shown = split_held_out(views)[0][4]
    trained = join(scene.splats, floater_before(scene, views.index(shown)))
    moved = showing(scene, trained, [shown], tmp_path / "photographs")
    result, _ = run(moved, trained, tmp_path)
    photographs = load_evaluation_views(moved.reconstruction.folder, [shown], trained.draw_settings)
    before, after = (mean_psnr_db(s, photographs, "cpu") for s in (trained, result))
    assert after >= before - 0.3


def test_held_out_views_that_lose_more_are_in_a_warning(scene, tmp_path) -> None:
    """Held-out views show what no training view shows, so that it is removed."""
    trained = join(scene.splats, floater_before(scene, 1))
    held_out = split_held_out(scene.reconstruction.views)[1]
    moved = showing(scene, trained, held_out, tmp_path / "photographs")
    _, report = run(moved, trained, tmp_path)
    lost_db = -report.metrics["psnr_change_db"]
    assert lost_db > 0.1
    [(code, message)] = report.warnings
    assert code == "prune-loss-above-limit"
    assert f"{lost_db:.2f} dB on average" in message
    _, forced = run(moved, trained, tmp_path, max_splats=100)
    assert not forced.warnings
    _, report = run(moved, trained, tmp_path, max_splats=1000)  # a target that forces nothing
    assert [code for code, _ in report.warnings] == ["prune-loss-above-limit"]


@pytest.mark.parametrize(("count", "advised"), [(1, False), (2, False), (3, True)])
def test_more_splats_are_not_advised_where_too_few_views_decide(
    tmp_path, count: int, advised: bool
) -> None:
    scene = small_scene(tmp_path, n=60)  # a tenth of them would do
    few = replace(scene.reconstruction, views=scene.reconstruction.views[:count])
    _, report = run(replace(scene, reconstruction=few), scene.splats, tmp_path)
    assert ("prune-more-would-pay" in dict(report.warnings)) == advised


def test_at_low_strength_nothing_is_removed_that_the_views_show(scene, tmp_path) -> None:
    result, report = run(scene, scene.splats, tmp_path, strength=0.001, max_loss_db=100)
    assert report.metrics["stopped_by"] == "rate_distortion"
    assert training_db(scene, result) >= training_db(scene, scene.splats) - 0.02
    assert len(result) > 0.8 * len(scene.splats)


def test_held_out_views_without_a_pixel_that_counts_are_in_no_figure(scene, tmp_path) -> None:
    """Masks leave nothing of one held-out view of two, or of both."""
    Image.fromarray(np.zeros((54, 72), np.uint8)).save(tmp_path / "nothing.png")
    held_out = split_held_out(scene.reconstruction.views)[1]
    figures = []
    for names in ([held_out[0].name], [view.name for view in held_out]):
        views = tuple(
            replace(view, mask=str(tmp_path / "nothing.png"), outside=IGNORE)
            if view.name in names
            else view
            for view in scene.reconstruction.views
        )
        masked = replace(scene, reconstruction=replace(scene.reconstruction, views=views))
        _, report = run(masked, scene.splats, tmp_path)
        figures.append([v for name, v in report.metrics.items() if name.startswith("psnr_")])
    assert np.isfinite(figures).all()
    assert min(before for before, *_ in figures) > 30


def test_the_loss_of_a_round_is_predicted(scene, tmp_path) -> None:
    _, report = run(scene, scene.splats, tmp_path, max_splats=230)
    first = report.metrics["rounds"][0]
    assert first["removed"] == 20
    # at first a fifth of the prediction is what splats cost that could replace each other
    assert first["measured_sse"] == pytest.approx(first["predicted_sse"], rel=0.25)


def test_finetuning_recovers_a_part_of_the_loss(scene, tmp_path) -> None:
    pruned, _ = run(scene, scene.splats, tmp_path, max_splats=150, rounds=0)
    finetuned, report = run(scene, scene.splats, tmp_path, max_splats=150, finetune_steps=20)
    assert len(pruned) == len(finetuned) == 150
    assert training_db(scene, finetuned) > training_db(scene, pruned) + 0.5
    assert report.metrics["finetune_steps"] <= 8 * 20


def test_removed_sh_coefficients_stay_zero_in_finetuning(scene, tmp_path) -> None:
    result, report = run(scene, scene.splats, tmp_path, strength=20, finetune_steps=10)
    degrees = np.floor(np.sqrt(np.arange(result.sh.shape[1])))
    above = degrees[None] > result.sh_degrees[:, None]
    assert (result.sh_degrees < 2).any()
    assert not result.sh[above].any()
    assert sum(report.metrics["splats_by_sh_degree"]) == len(result)


def test_a_size_in_megabytes_is_met_from_below(scene, tmp_path) -> None:
    result, _ = run(scene, scene.splats, tmp_path, max_mb=0.02, mb_of="spz", rounds=0)
    path = tmp_path / "scene.spz"
    formats.write(path, result)
    assert path.stat().st_size <= 20_000
    few, _ = run(scene, scene.splats, tmp_path, max_mb=0.016, rounds=0)
    path = tmp_path / "scene.ply"
    formats.write(path, few)
    assert 0.95 * 16_000 < path.stat().st_size <= 16_000


@pytest.mark.parametrize("kept", [1, 20, 150])
def test_a_size_that_is_mostly_the_page_is_met(scene, tmp_path, kept: int) -> None:
    reconstruction = scene.reconstruction
    known = {"units": reconstruction.units, "views": reconstruction.views}
    path = tmp_path / "scene.html"
    formats.write(path, scene.splats.take(slice(kept)), **known)
    wanted = 1.001 * path.stat().st_size
    result, _ = run(scene, scene.splats, tmp_path, max_mb=wanted / 1e6, mb_of="html")
    formats.write(path, result, **known)
    assert path.stat().st_size <= wanted
    assert len(result) > 0.8 * kept


def test_a_round_that_is_predicted_to_cost_too_much_is_not_measured(
    scene, tmp_path, monkeypatch
) -> None:
    measured = []
    measure = contribution.measure_contributions

    def counting(*args, **settings) -> Contributions:
        measured.append(args)
        return measure(*args, **settings)

    monkeypatch.setattr(pruning, "measure_contributions", counting)
    _, report = run(scene, scene.splats, tmp_path, max_loss_db=1e-6)
    assert report.metrics["stopped_by"] == "loss"
    assert len(measured) == 1  # before the first round


@pytest.mark.parametrize("lower_db", [3, 18])
def test_a_psnr_is_met_and_no_better_than_needed(scene, tmp_path, lower_db: int) -> None:
    wanted = training_db(scene, scene.splats) - lower_db  # the second needs many rounds
    result, report = run(scene, scene.splats, tmp_path, min_psnr=wanted)
    assert wanted <= training_db(scene, result) < wanted + 0.5
    assert len(result) < len(scene.splats)
    assert report.metrics["stopped_by"] == "loss"


def test_a_psnr_with_no_rounds_removes_nothing(scene, tmp_path) -> None:
    result, _ = run(scene, scene.splats, tmp_path, min_psnr=10, rounds=0)
    assert len(result) == len(scene.splats)


@pytest.mark.parametrize(
    ("settings", "code", "named"),
    [
        ({"min_psnr": 90}, "prune-psnr-not-reached", "At most 3"),
        ({"max_mb": 1e-5}, "prune-too-small", "1 splat takes."),
        ({"max_splats": 60, "min_psnr": 30}, "prune-targets-contradict", "--min-psnr 18"),
    ],
)
def test_targets_that_cannot_be_met_are_refused_with_what_can_be_met(
    scene, tmp_path, settings, code, named
):
    with pytest.raises(SplatError) as caught:
        run(scene, scene.splats, tmp_path, rounds=0, **settings)
    assert caught.value.code == code
    assert named in str(caught.value)


def test_a_size_that_one_splat_exceeds_is_refused_before_any_picture_is_read(
    scene, tmp_path, monkeypatch
) -> None:
    monkeypatch.setattr(prune, "load_evaluation_views", lambda *_: 1 / 0)
    with pytest.raises(SplatError) as caught:
        run(scene, scene.splats, tmp_path, max_mb=0.001)
    assert caught.value.code == "prune-too-small"
    assert "1 splat take" in caught.value.given


def test_the_report_says_what_was_removed_and_why(scene, tmp_path) -> None:
    _, report = run(scene, scene.splats, tmp_path, max_loss_db=0.02)
    cost, removed, why = report.metrics["summary"]
    assert "independent" in cost
    assert f"of {len(scene.splats):,}" in removed
    assert "more than is allowed" in why


def test_no_round_begins_after_the_time_limit(scene, tmp_path) -> None:
    _, report = run(scene, scene.splats, tmp_path, seconds=1e-6, strength=100)
    assert report.metrics["stopped_by"] == "time"


def test_no_rounds_remove_nothing(scene, tmp_path) -> None:
    trained = join(scene.splats, unseen(5))
    result, report = run(scene, trained, tmp_path, rounds=0)
    assert len(result) == len(trained)
    assert report.metrics["psnr_change_db"] == 0


def test_measuring_a_part_of_the_views_removes_about_as_much_at_no_more_loss(
    scene, tmp_path, monkeypatch
) -> None:
    trained = join(scene.splats, unseen(5), floater_before(scene, 1))
    reference, _ = run(scene, trained, tmp_path)
    monkeypatch.setattr(pruning, "MAX_MEASURED_VIEWS", 4)
    result, report = run(scene, trained, tmp_path)
    assert len(result) == pytest.approx(len(reference), rel=0.15)
    assert training_db(scene, result) > training_db(scene, reference) - 0.3
    assert not rows_of(unseen(5), result).any()
    # predictions are about all views, measurements come from some of them
    significant = [one for one in report.metrics["rounds"] if one["predicted_sse"] > 1]
    assert all(0.4 < one["measured_sse"] / one["predicted_sse"] < 2.5 for one in significant)


def test_what_only_an_unmeasured_view_shows_stays(scene, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(pruning, "MAX_MEASURED_VIEWS", 1)  # of nine, the first
    result, _ = run(scene, scene.splats, tmp_path)
    far = scene.reconstruction.views[5].camera
    seen = [Splats.take(s, far.project(s.means)[1] < 3) for s in (scene.splats, result)]
    assert len(seen[1]) > 0.4 * len(seen[0])
    assert training_db(scene, result) > training_db(scene, scene.splats) - 3


def test_the_same_input_gives_the_same_bytes_and_load_gives_them_back(scene, tmp_path) -> None:
    trained = join(scene.splats, unseen(5), floater_before(scene, 2))
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        result, _ = run(scene, trained, tmp_path / name)
    a, b = (sorted((tmp_path / name).iterdir()) for name in ("a", "b"))
    assert [p.read_bytes() for p in a] == [p.read_bytes() for p in b]
    assert (prune.load(tmp_path / "a").splats.means == result.means).all()


def test_the_origin_stays(scene, tmp_path) -> None:
    origin = np.array([5e5, 0.0, -4.0])
    result, _ = run(scene, replace(scene.splats, origin=origin), tmp_path)
    assert (result.origin == origin).all()


def contributions_of(view_counts, sse_change, scene_depth=(4.0,)) -> Contributions:
    """What the rules read of contributions; a splat in no view has no weight."""
    seen = np.asarray(view_counts, np.int32)
    weight = (seen > 0).astype(np.float64)
    change, depth = np.asarray(sse_change, np.float64), np.asarray(scene_depth, np.float64)
    no_sh = np.zeros((len(seen), 0))
    return Contributions(
        change, change, weight, weight, seen, 1.0, depth, no_sh, no_sh, no_sh, depth
    )


def test_a_floater_is_close_to_a_camera_and_needed_by_few() -> None:
    """One camera at the origin that sees its scene 4 away: close is nearer than 1."""
    scene = splats([[0, 0, 0.9], [0, 0, 1.1], [0, 0, 0.9], [0.4, 0, 0.6], [0, 0, 0.5]])
    contributions = contributions_of([1, 1, 3, 2, 0], [1.0] * 5)
    assert near_camera_floaters(scene, contributions, [camera()]).tolist() == [
        True,
        False,
        False,
        True,
        True,
    ]


def test_a_wall_beside_or_behind_a_camera_is_no_floater() -> None:
    """The camera of the test above stands 0.5 from a wall that two further ones see."""
    wall = splats([[0.5, 0, -0.5], [0.5, 0, 0.0], [0.5, 0, 0.3], [0, 0, -0.5]])
    contributions = contributions_of([2] * 4, [1.0] * 4)
    assert not near_camera_floaters(wall, contributions, [camera()]).any()


def test_a_camera_that_sees_nothing_solid_makes_no_floaters() -> None:
    contributions = contributions_of([1], [1.0], scene_depth=[np.inf])
    assert not near_camera_floaters(splats([[0, 0, 0.1]]), contributions, [camera()]).any()


def test_near_a_frustum_is_a_quarter_of_the_longer_side_beyond_the_edge() -> None:
    """A camera of 64 x 48 pixels and focal length 60 sees x of -0.53 to 0.53 at depth 1."""
    scene = splats([[0, 0, 1], [0.75, 0, 1], [0.85, 0, 1], [0, 0, -1]])
    assert near_view_frusta(scene, [camera()]).tolist() == [True, True, False, False]


def test_what_few_views_show_is_removed_last() -> None:
    """Of five splats, three are seen by one or two views; the two others contribute more."""
    seen_by, change = [1, 2, 3, 5, 2], [1e-6, 1e-5, 0.1, 0.2, 1e-6]
    scene = splats([[0.1 * i, 0.0, 3.0] for i in range(5)])
    contributions = contributions_of(seen_by, change)
    removal = select_removal(scene, contributions, [camera()], RemovalLimits(1.0, 5))
    assert removal is not None
    assert not removal.removed[[0, 1, 4]].any()
    assert removal.removed[[2, 3]].any()
    forced = select_removal(scene, contributions, [camera()], RemovalLimits(np.inf, 5))
    assert forced is not None
    assert forced.removed.sum() > removal.removed.sum()
