"""A run's splats and the files in its export folder are measured and drawn in the same way."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from stages import formats
from stages.run import pipeline, results
from stages.run.pipeline import Pipeline
from stages.scene import DrawSettings, QuantisedSplats, TrainedSplats
from tests.small_scene import small_scene

Outputs = dict[str, Any]


@pytest.fixture
def outputs(splat, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Outputs:
    """What the stages of the finished run `run` hold, by name: a small scene whose photographs
    training made smaller and corrected to their median light."""
    splat("process", "photos")
    (tmp_path / "pictures").mkdir()
    scene = small_scene(tmp_path / "pictures")
    brighter = (0.3, 0.3, 0.3)
    views = tuple(replace(view, light=brighter) for view in scene.reconstruction.views)
    settings = DrawSettings(near=0.01, side=40, light=True, antialias=True)
    splats = replace(scene.splats, draw_settings=settings, origin=scene.reconstruction.origin)
    held = {
        "sfm": replace(scene.reconstruction, views=views),
        "train": TrainedSplats(splats),
        "prune": splats,
        "quantise": QuantisedSplats(splats, {}),
    }

    def loading(name: str) -> Callable[[Path], Any]:
        return lambda folder: held[name]

    stages = (
        replace(stage, load=loading(stage.name)) if stage.name in held else stage
        for stage in Pipeline(Path("run")).layout.stages
    )
    monkeypatch.setattr(pipeline, "STAGES", tuple(stages))
    formats.write(Path("run/7-export/scene.html"), splats)
    return held


def psnr_db(splat, source: str, *more: str) -> float:
    """Before any operation, as `splat edit` prints it."""
    result = splat("edit", source, "--dry-run", "--scale", "1", "--json", *more)
    assert result.exit_code == 0, result.stderr
    return json.loads(result.stdout.splitlines()[-1])["psnr_before_db"]


def test_a_file_in_the_export_folder_is_measured_as_its_run(splat, outputs: Outputs) -> None:
    of_run = psnr_db(splat, "run", "out.html")
    assert psnr_db(splat, "run/7-export/scene.html") == pytest.approx(of_run, abs=0.01)
    as_photographed = replace(outputs["train"].splats, draw_settings=DrawSettings(0.01))
    outputs["train"] = TrainedSplats(as_photographed)
    assert psnr_db(splat, "run/7-export/scene.html") != pytest.approx(of_run, abs=0.1)


def test_a_file_beside_a_run_without_training_is_drawn_by_its_cameras(outputs: Outputs) -> None:
    Path("run/4-train/manifest.json").unlink()
    found = results.read_file(Path("run/7-export/scene.html")).draw_settings
    assert (found.side, found.light, found.antialias) == (0, False, True)
    assert found.near > 0
