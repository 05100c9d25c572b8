"""Fine-tuning of given splats."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from stages.base.stage import Report
from stages.evaluate.evaluation import load_evaluation_views
from stages.scene import split_held_out, training_extent
from stages.train.finetune import FineTuner
from tests.small_scene import small_scene

PARAMETERS = {"means", "quaternions", "log_scales", "opacity_logits", "sh_dc", "sh_rest"}


@pytest.mark.parametrize("dropout", [False, True])
def test_frozen_parameters_do_not_change_by_a_bit(tmp_path: Path, dropout: bool) -> None:
    scene = small_scene(tmp_path, noise=0.0)
    splats, folder = scene.splats, scene.reconstruction.folder
    training = split_held_out(scene.reconstruction.views)[0]
    views = load_evaluation_views(folder, training, splats.draw_settings)
    extent, counts = training_extent(scene.reconstruction), np.zeros(len(splats), np.int32)
    for name in sorted(PARAMETERS):
        frozen = PARAMETERS - {name}
        finetuner = FineTuner(views, extent, "cpu", Report(), dropout)
        found = finetuner.finetune(splats, 3, counts, frozen)
        same = {
            "means": np.array_equal(found.means, splats.means),
            "quaternions": np.array_equal(found.quaternions, splats.quaternions),
            "log_scales": np.array_equal(found.log_scales, splats.log_scales),
            "opacity_logits": np.array_equal(found.opacity_logits, splats.opacity_logits),
            "sh_dc": np.array_equal(found.sh[:, 0], splats.sh[:, 0]),
            "sh_rest": np.array_equal(found.sh[:, 1:], splats.sh[:, 1:]),
        }
        assert {key for key, is_same in same.items() if is_same} == frozen
