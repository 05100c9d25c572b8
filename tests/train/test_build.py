"""What is warned of before training."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from stages.base.stage import Report
from stages.train.build import make_trainer
from stages.train.settings import TrainSettings
from tests.small_scene import small_scene


def test_each_small_photograph_is_counted_once(tmp_path: Path) -> None:
    """However many faces it has, and without the promise that --max-side makes it larger."""
    scene = small_scene(tmp_path, 8)
    numbered = enumerate(scene.reconstruction.views)
    faces = tuple(replace(view, frame=f"{i % 4}.jpg" if i < 6 else "") for i, view in numbered)
    report = Report()
    settings = TrainSettings(max_splats=100, train_side=100)
    made = replace(scene.reconstruction, views=faces)
    make_trainer(made, scene.splats, settings, tmp_path, report)
    warnings = dict(report.warnings)
    assert "100: 6 photographs." in warnings["train-photographs-smaller"]
    assert "only where ingest made them so small" in warnings["train-photographs-smaller"]
