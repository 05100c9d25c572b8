"""Fine-tuning of given splats."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from stages.base.stage import Report
from stages.evaluate.evaluation import load_evaluation_views
from stages.scene import split_held_out, training_extent
from stages.train.finetune import FineTuner
from stages.train.steps.step import StepInput
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


def test_steps_use_smaller_views_as_often_as_training_does_but_the_last_ones_do_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = small_scene(tmp_path, noise=0.0)
    training = split_held_out(scene.reconstruction.views)[0]
    views = load_evaluation_views(scene.reconstruction.folder, training, scene.splats.draw_settings)
    finetuner = FineTuner(views, training_extent(scene.reconstruction), "cpu", Report())
    given: list[StepInput] = []
    monkeypatch.setattr(finetuner._stepper, "step", given.append)
    for _ in range(2):
        finetuner.finetune(scene.splats, 20, np.zeros(len(scene.splats), np.int32))
    full = views[0].camera.width
    sizes = [(one.level.camera.width / full, one.weight) for one in given]
    assert Counter(sizes) == {(1.0, 1.0): 34, (0.5, 4.0): 2, (0.25, 16.0): 2, (0.125, 64.0): 2}
    assert sizes[17:20] == sizes[37:] == [(1.0, 1.0)] * 3
