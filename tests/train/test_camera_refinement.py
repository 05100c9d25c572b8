"""Cameras refined in training: their gradients, and shaken cameras that come back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stages.base.errors import Interrupted
from stages.base.stage import Report
from stages.evaluate.evaluation import load_evaluation_views, mean_psnr_db
from stages.prune import stage as prune
from stages.prune.settings import PruneSettings
from stages.quantise import stage as quantise
from stages.quantise.settings import QuantiseSettings
from stages.raster.cpu.rasteriser import CpuRasteriser
from stages.raster.definition import RasterSettings
from stages.scene import PrunedSplats, Reconstruction, RefinedCameras, TrainedSplats, split_held_out
from stages.train import stage as train
from stages.train.camera_refinement import camera_gradients
from stages.train.conversion import model_of
from stages.train.settings import TrainSettings
from stages.train.steps.step import step_of
from tests.small_scene import small_scene

SETTINGS = RasterSettings(near=0.1, sh_degree=0)
QUICK = {
    prune: PruneSettings(rounds=0),
    quantise: QuantiseSettings(rounding_steps=0),
}


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return small_scene(tmp_path_factory.mktemp("photographs"))


def moved(world_to_camera, turn, shift):
    """The pose after a turn (rotation vector) and a shift in the frame of the camera."""
    move = np.eye(4)
    move[:3, :3], move[:3, 3] = Rotation.from_rotvec(turn).as_matrix(), shift
    return move @ world_to_camera


def test_gradients_by_the_camera_are_those_of_differences(scene) -> None:
    """Of a smooth function of the picture, by all parameters of the pose and the focal length. The
    differences are wide: splats enter and leave pixels at an alpha of 1/255."""
    camera, size = scene.reconstruction.views[0].camera, 1e-3
    model, rasteriser = model_of(scene.splats.with_sh_degree(0)), CpuRasteriser()
    y, x = np.mgrid[:54, :72]
    weights = np.stack([np.cos(x / 9 + k) * np.sin(y / 7 + k) for k in range(3)])

    def forward(seen):
        return rasteriser.forward(model.drawn(False), seen, SETTINGS)

    def slope(changed) -> float:
        """Of the function by what `changed` changes by a given size."""
        ahead, behind = ((forward(changed(s)).image[:3] * weights).sum() for s in (size, -size))
        return float(ahead - behind) / (2 * size)

    def posed(k):
        way = np.eye(6)[k]
        pose = camera.world_to_camera
        return lambda s: replace(camera, world_to_camera=moved(pose, s * way[:3], s * way[3:]))

    backward = rasteriser.backward(forward(camera), weights.astype(np.float32))
    pose, focal = camera_gradients(camera.world_to_camera, model, backward)
    by_difference = [slope(posed(k)) for k in range(6)]
    np.testing.assert_allclose(pose, by_difference, atol=0.1 * np.abs(by_difference).max())
    zoomed = slope(lambda s: replace(camera, fx=camera.fx * (1 + s), fy=camera.fy * (1 + s)))
    assert focal == pytest.approx(zoomed, rel=0.05)


def shaken(scene, size: float, held_out: bool = False) -> Reconstruction:
    """The small scene with every camera moved by about `size`; held-out ones if that is wanted."""
    rng, views = np.random.default_rng(4), []
    for number, view in enumerate(scene.reconstruction.views):
        turn, shift = rng.normal(0, size / 3, 3), rng.normal(0, size, 3)
        if number % 8 == 0 and not held_out:
            views.append(view)
            continue
        pose = moved(view.camera.world_to_camera, turn, shift)
        views.append(replace(view, camera=replace(view.camera, world_to_camera=pose)))
    return replace(scene.reconstruction, views=tuple(views))


def trained(scene, views, folder, report=None, **settings) -> tuple[TrainedSplats, Report]:
    folder.mkdir(exist_ok=True)
    report = report or Report()
    wanted = TrainSettings(
        **{"steps": 600, "train_side": 72, "sh_degree": 0, "max_splats": 600} | settings
    )
    given = replace(scene.splats.with_sh_degree(0), opacity_logits=scene.splats.opacity_logits - 1)
    return train.run({"sfm": views, "seed": given}, wanted, folder, report), report


def relative_errors_deg(found, true) -> np.ndarray:
    """Of the rotations between neighbouring training cameras: the whole may have turned."""
    poses = [
        np.array([view.camera.world_to_camera[:3, :3] for view in split_held_out(r.views)[0]])
        for r in (found, true)
    ]
    found_between, true_between = (r[1:] @ r[:-1].transpose(0, 2, 1) for r in poses)
    turned = Rotation.from_matrix(found_between @ true_between.transpose(0, 2, 1))
    return np.degrees(turned.magnitude())


def test_shaken_cameras_are_put_right(scene, tmp_path) -> None:
    """To less than two thirds of their error, and what is held out is drawn better."""
    views, true = shaken(scene, 0.03), scene.reconstruction
    _, plain = trained(scene, views, tmp_path / "plain")
    found, report = trained(scene, views, tmp_path / "refined", refine_in_training=True)
    after = relative_errors_deg(views.with_cameras(found.cameras), true)
    assert np.median(after) < np.median(relative_errors_deg(views, true)) * 2 / 3
    assert report.metrics["psnr_db"] > plain.metrics["psnr_db"] + 1
    assert report.metrics["cameras_moved"] > 0.01


def test_refined_cameras_are_kept_with_the_splats(scene, tmp_path) -> None:
    found, _ = trained(
        scene, scene.reconstruction, tmp_path / "kept", refine_in_training=True, steps=30
    )
    read = train.load(tmp_path / "kept")
    assert found.cameras is not None
    assert read.cameras is not None
    assert read.cameras.focal_factor == found.cameras.focal_factor != 1.0
    for name, pose in found.cameras.poses.items():
        np.testing.assert_array_equal(read.cameras.poses[name], pose)
    first = scene.reconstruction.views[0].camera
    refined = scene.reconstruction.with_cameras(read.cameras).views[0].camera
    assert refined.fx == pytest.approx(first.fx * read.cameras.focal_factor)


def test_without_the_option_cameras_stay(scene, tmp_path) -> None:
    found, report = trained(scene, scene.reconstruction, tmp_path / "as they are", steps=30)
    assert found.cameras is None
    assert "focal_factor" not in report.metrics
    assert scene.reconstruction.with_cameras(found.cameras) is scene.reconstruction


@pytest.mark.parametrize("stopped", [("training", 50), ("registering", 1)])
def test_a_resumed_run_ends_in_the_same_cameras(scene, tmp_path, stopped) -> None:
    options = {"steps": 80, "refine_in_training": True}
    whole, _ = trained(scene, scene.reconstruction, tmp_path / "whole", **options)
    report = Report()

    def stop(label, done, total, numbers) -> None:
        if (label, done) == stopped:
            report.stop_requested.set()

    report.listener = stop
    with pytest.raises(Interrupted):
        trained(scene, scene.reconstruction, tmp_path / "parts", report, **options)
    found, again = trained(scene, scene.reconstruction, tmp_path / "parts", **options)
    assert again.metrics["resumed_from_step"] == {"training": 51, "registering": 80}[stopped[0]]
    assert found.splats.means.tobytes() == whole.splats.means.tobytes()
    assert found.cameras is not None
    assert whole.cameras is not None
    assert found.cameras.focal_factor == whole.cameras.focal_factor
    for name, pose in whole.cameras.poses.items():
        assert found.cameras.poses[name].tobytes() == pose.tobytes()


def test_every_step_on_the_host_gives_its_gradients(scene) -> None:
    from stages.train.optimiser import LearningRates
    from stages.train.steps.step import StepInput
    from stages.train.views import Level

    view = scene.reconstruction.views[0]
    level = Level.from_pixels(view.camera, np.zeros((54, 72, 3), np.uint8))
    found = []
    for backend in ("cpu", "reference"):
        stepper = step_of(backend)
        stepper.load(model_of(scene.splats.with_sh_degree(0)))

        def keep(model, backward) -> None:
            found.append(camera_gradients(view.camera.world_to_camera, model, backward))

        stepper.step(StepInput(level, SETTINGS, LearningRates(), use_gradients=keep))
    np.testing.assert_allclose(found[0][0], found[1][0], rtol=1e-3, atol=1e-3)
    assert found[0][1] == pytest.approx(found[1][1], rel=1e-3)


@pytest.mark.parametrize("stage", [prune, quantise])
def test_later_stages_measure_from_the_refined_cameras(scene, tmp_path, stage) -> None:
    true = scene.reconstruction
    cameras = RefinedCameras({v.name: v.camera.world_to_camera for v in true.views}, 1.0)
    report = Report()
    inputs = {
        "sfm": shaken(scene, 0.03, held_out=True),
        "train": TrainedSplats(scene.splats, cameras=cameras),
        "prune": PrunedSplats(scene.splats),
    }
    stage.run(inputs, QUICK[stage], tmp_path, report)
    right_db = mean_psnr_db(scene.splats, held_out_of(true, scene.splats), "cpu")
    assert right_db > 30
    name = "psnr_before_db" if stage is prune else "psnr_raw_db"
    assert report.metrics[name] == pytest.approx(right_db, abs=0.01)


def held_out_of(reconstruction, splats):
    views = split_held_out(reconstruction.views)[1]
    return load_evaluation_views(reconstruction.folder, views, splats.draw_settings)
