"""Training does not depend on the unit of length."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stages.base.stage import Report
from stages.run.stages import STAGE_OF
from stages.scene import Reconstruction, Splats
from stages.train import stage as train
from stages.train.build import make_trainer
from stages.train.settings import TrainSettings
from tests.small_scene import small_scene


def in_units(made: Reconstruction, scale: float) -> Reconstruction:
    """The same capture, with all lengths times `scale`."""
    views = []
    for view in made.views:
        matrix = view.camera.world_to_camera.copy()
        matrix[:3, 3] *= scale
        views.append(replace(view, camera=replace(view.camera, world_to_camera=matrix)))
    return replace(made, views=tuple(views), points=scale * made.points)


def splats_in_units(splats: Splats, scale: float) -> Splats:
    means = (scale * splats.means.astype(np.float64)).astype(np.float32)
    log_scales = (splats.log_scales + np.log(scale)).astype(np.float32)
    return replace(splats, means=means, log_scales=log_scales)


@pytest.mark.slow
def test_a_run_ends_with_the_same_picture_in_any_unit(sample_run: Path, tmp_path: Path) -> None:
    run = sample_run / "run"
    reconstruction = STAGE_OF["sfm"].load(run / "2-sfm")
    start = STAGE_OF["seed"].load(run / "3-seed")
    settings = TrainSettings(steps=400, train_side=160, sh_degree=1, max_splats=8000)
    found = {}
    for scale in (1.0, 0.999, 1e-6, 1e6):
        inputs = {
            "sfm": in_units(reconstruction, scale),
            "seed": splats_in_units(start, scale),
        }
        folder, report = tmp_path / f"{scale:g}", Report()
        folder.mkdir()
        train.run(inputs, settings, folder, report)
        found[scale] = report.metrics["psnr_db"]
    # Rounding decides which splats grow: a unit 0.1 % longer moves so short a run by 0.2 dB.
    low, high = sorted((found[1.0], found[0.999]))
    assert all(low - 0.1 < psnr_db < high + 0.1 for psnr_db in found.values()), found


def test_dropout_is_decided_by_the_number_of_views_alone(tmp_path: Path) -> None:
    for views in (16, 18):  # of which 2 and 3 are held out
        scene = small_scene(tmp_path, views)
        made = scene.reconstruction
        decisions = [
            make_trainer(
                in_units(made, scale),
                scene.splats,
                TrainSettings(max_splats=100),
                tmp_path,
                Report(),
            ).task.dropout
            for scale in (1.0, 0.999, 1e-6, 1e6)
        ]
        assert decisions == [views == 16] * 4
