"""An ordinary walk around an object in a hall does not lose the hall."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from stages.base.stage import Report
from stages.evaluate.evaluation import image_renderer, load_evaluation_views
from stages.evaluate.image_metrics import capped_psnr_db
from stages.run.stages import STAGE_OF
from stages.scene import Reconstruction, Splats, draw_settings_of
from stages.seed.settings import SeedSettings
from stages.train.settings import TrainSettings
from tests.benchmarks import table_in_hall
from tests.tolerances import BACKGROUND_DB, LEARNT_LESS_DB, UNLEARNT_DB

WIDTH = 160
SETTINGS = TrainSettings(steps=500, train_side=WIDTH, sh_degree=1, max_splats=8000)
Trained = tuple[Reconstruction, Splats, dict[str, Any]]


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Trained:
    """(the capture with its test views, the splats of a short run on its walk, its metrics)."""
    made = table_in_hall.capture(tmp_path_factory.mktemp("pictures"), WIDTH)
    given, folder, report = table_in_hall.of_walk(made), tmp_path_factory.mktemp("run"), Report()
    seeds = STAGE_OF["seed"].run({"sfm": given}, SeedSettings(fill=False), folder, Report())
    inputs = {"sfm": given, "seed": seeds}
    splats = STAGE_OF["train"].run(inputs, SETTINGS, folder, report).splats
    return made, splats, report.metrics


def mean_psnr_db(made: Reconstruction, splats: Splats, part: str) -> float:
    """Of the pixels of the test views that show this part, over those that show any."""
    draw, tests = image_renderer(splats, "auto"), table_in_hall.of_test(made)
    settings = draw_settings_of(table_in_hall.of_walk(made), WIDTH)
    found = []
    for view in load_evaluation_views(made.folder, tests, settings):
        shown = shows(view.camera.world_to_camera, part)
        if shown.any():
            found.append(capped_psnr_db(draw(view.camera), view.image, shown))
    return float(np.mean(found))


def shows(pose: NDArray[np.float64], part: str) -> NDArray[np.bool_]:
    """[H, W] the pixels that show it."""
    if part == "outside":
        return table_in_hall.shows_outside(pose, WIDTH)
    background = table_in_hall.shows_background(pose, WIDTH)
    return background if part == "background" else ~background


@pytest.mark.slow
def test_the_background_of_held_out_pictures_is_learnt_as_the_object_is(trained: Trained) -> None:
    made, splats, _ = trained
    found = {name: mean_psnr_db(made, splats, name) for name in ("near", "background", "outside")}
    assert found["background"] > found["near"] - LEARNT_LESS_DB, found
    assert all(found[name] > least for name, least in BACKGROUND_DB.items()), found


@pytest.mark.slow
def test_held_out_pictures_lose_nothing_in_the_course_of_training(trained: Trained) -> None:
    psnr_db = np.array([entry["psnr_db"] for entry in trained[2]["history"]])
    fallen = np.maximum.accumulate(psnr_db) - psnr_db
    assert fallen.max() < UNLEARNT_DB, psnr_db
