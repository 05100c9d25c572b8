"""Pruning: what hangs before a camera and what nobody sees goes; the pictures stay."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stages import prune
from stages.base.stage import Report
from stages.measure.judge import load_photographs, mean_psnr_db
from stages.measure.worth import Worth, beside_pictures, floaters, measure_worth, unneeded
from stages.scene import Splats, split_held_out
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
    report = Report()
    inputs = {"sfm": scene.reconstruction, "train": trained}
    return prune.run(inputs, prune.PruneSettings(**settings), folder, report), report


def rows_of(part: Splats, whole: Splats) -> np.ndarray:
    """[len(part)] whether each of its splats is (still) in `whole`."""
    return (part.means[:, None] == whole.means[None]).all(2).any(1)


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> SmallScene:
    return small_scene(tmp_path_factory.mktemp("photographs"))


@pytest.mark.parametrize(
    ("view", "counted_as"),
    [(4, "floaters_removed"), (1, "unneeded_removed")],  # seen from afar by 1 and by 3 others
)
def test_a_splat_close_before_one_camera_goes(scene, tmp_path, view, counted_as) -> None:
    floater = floater_before(scene, view)
    _, usual = run(scene, scene.splats, tmp_path)
    result, report = run(scene, join(scene.splats, floater), tmp_path)
    assert not rows_of(floater, result).any()
    assert report.metrics[counted_as] > usual.metrics[counted_as]
    assert report.metrics["psnr_change_db"] >= -0.05


def test_splats_that_no_photograph_sees_go(scene, tmp_path) -> None:
    lost = unseen(12)
    result, report = run(scene, join(scene.splats, lost), tmp_path)
    assert not rows_of(lost, result).any()
    assert report.metrics["unneeded_removed"] >= 12
    assert report.metrics["psnr_change_db"] >= -0.05
    assert report.metrics["splats_before"] == len(scene.splats) + 12
    assert report.metrics["splats"] == len(result)
    removed = report.metrics["floaters_removed"] + report.metrics["unneeded_removed"]
    assert removed == report.metrics["splats_before"] - len(result)


def test_most_of_a_true_scene_stays(scene, tmp_path) -> None:
    """What the photographs were drawn from, less what none of them shows."""
    views = scene.reconstruction.views
    photographs = load_photographs(scene.reconstruction.folder, views, scene.splats.look)
    worth = measure_worth(scene.splats, photographs, "cpu")
    needed = worth.sse_change > 0.01 * np.median(worth.sse_change)
    result, _ = run(scene, scene.splats, tmp_path)
    assert rows_of(scene.splats.take(needed), result).all()


def test_no_loss_allowed_is_no_loss_of_the_photographs_that_decide(scene, tmp_path) -> None:
    trained = join(scene.splats, floater_before(scene, 1), unseen(20))
    result, _ = run(scene, trained, tmp_path, max_loss_db=0.0)
    training, _ = split_held_out(scene.reconstruction.views)
    photographs = load_photographs(scene.reconstruction.folder, training, trained.look)
    before, after = (mean_psnr_db(splats, photographs, "cpu") for splats in (trained, result))
    assert after >= before


def test_no_rounds_remove_nothing(scene, tmp_path) -> None:
    trained = join(scene.splats, unseen(5))
    result, report = run(scene, trained, tmp_path, rounds=0)
    assert len(result) == len(trained)
    assert report.metrics["psnr_change_db"] == 0


def test_the_same_input_gives_the_same_bytes_and_load_gives_them_back(scene, tmp_path) -> None:
    trained = join(scene.splats, unseen(5), floater_before(scene, 2))
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        result, _ = run(scene, trained, tmp_path / name)
    a, b = (sorted((tmp_path / name).iterdir()) for name in ("a", "b"))
    assert [p.read_bytes() for p in a] == [p.read_bytes() for p in b]
    assert (prune.load(tmp_path / "a").means == result.means).all()


def test_the_origin_stays(scene, tmp_path) -> None:
    origin = np.array([5e5, 0.0, -4.0])
    result, _ = run(scene, replace(scene.splats, origin=origin), tmp_path)
    assert (result.origin == origin).all()


def worth_of(photographs, sse_change, scene_depth=(4.0,)) -> Worth:
    """A Worth with what the rules read; a splat in no photograph has no weight."""
    seen = np.asarray(photographs, np.int32)
    weight = (seen > 0).astype(np.float64)
    change, depth = np.asarray(sse_change, np.float64), np.asarray(scene_depth, np.float64)
    return Worth(change, weight, weight, seen, 1.0, depth)


def test_a_floater_is_close_to_a_camera_and_needed_by_few() -> None:
    """One camera at the origin that sees its scene 4 away: close is nearer than 1."""
    scene = splats([[0, 0, 0.9], [0, 0, 1.1], [0, 0, 0.9], [0, 0.9, 0.0], [0, 0, 0.5]])
    worth = worth_of([1, 1, 3, 2, 0], [1.0] * 5)
    assert floaters(scene, worth, [camera()]).tolist() == [True, False, False, True, True]


def test_a_camera_that_sees_nothing_solid_makes_no_floaters() -> None:
    worth = worth_of([1], [1.0], scene_depth=[np.inf])
    assert not floaters(splats([[0, 0, 0.1]]), worth, [camera()]).any()


def test_unneeded_is_what_photographs_are_better_without_or_lies_where_none_looks() -> None:
    worth = worth_of([0, 0, 1, 5, 5, 5], [0.0, 0.0, 1.0, -0.1, 0.0, 1e-6])
    beside = np.array([False, True, True, True, True, True])
    assert unneeded(worth, beside).tolist() == [True, False, False, True, True, False]


def test_beside_a_picture_is_a_quarter_of_its_longer_side_beyond_the_rim() -> None:
    """A camera of 64 x 48 pixels and focal length 60 sees x of -0.53 to 0.53 at depth 1."""
    scene = splats([[0, 0, 1], [0.75, 0, 1], [0.85, 0, 1], [0, 0, -1]])
    assert beside_pictures(scene, [camera()]).tolist() == [True, True, False, False]
