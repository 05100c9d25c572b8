"""A capture whose matches contradict its cameras: training decides whether it is wrong."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from stages.base.errors import SplatError
from stages.base.stage import Report
from stages.evaluate.verdict import WRONG
from stages.prune import stage as prune
from stages.prune.settings import PruneSettings
from stages.scene import TrainedSplats
from stages.seed import stage as seed
from stages.seed.settings import SeedSettings
from stages.sfm import stage as sfm
from stages.sfm.settings import SfmSettings
from stages.train import stage as train
from stages.train.settings import TrainSettings
from tests.sfm import room_captures
from tests.small_scene import small_scene


def test_a_wrong_result_is_not_pruned_unless_it_is_allowed(tmp_path: Path) -> None:
    scene = small_scene(tmp_path)
    inputs = {"sfm": scene.reconstruction, "train": TrainedSplats(scene.splats, contradicted=True)}
    settings = PruneSettings(finetune_steps=0, rounds=1)
    with pytest.raises(SplatError) as caught:
        prune.run(inputs, settings, tmp_path, Report())
    assert caught.value.code == "prune-contradictions"
    assert "--allow-partial" in caught.value.hint
    assert len(prune.run(inputs, replace(settings, allow_partial=True), tmp_path, Report()).splats)


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_large_object_turned_over_is_refused_when_training_fails(
    tmp_path: Path,
) -> None:
    capture, _ = room_captures.large_turned_over(tmp_path / "in")
    found = sfm.run({"ingest": capture}, SfmSettings(max_features=3000), tmp_path, Report())
    assert found.contradicted
    inputs: dict[str, Any] = {"sfm": found}
    inputs["seed"] = seed.run(inputs, SeedSettings(), tmp_path / "seed", Report())
    settings = TrainSettings(steps=400, train_side=240, max_splats=10_000)
    inputs["train"] = train.run(inputs, settings, tmp_path / "train", report := Report())
    assert report.metrics["verdict"]["grade"] == WRONG
    with pytest.raises(SplatError) as caught:
        prune.run(inputs, PruneSettings(), tmp_path / "prune", Report())
    assert caught.value.code == "prune-contradictions"
    assert "masks" in caught.value.hint
