"""Training that starts from trained splats, of another program or of an earlier run."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stages.base.stage import Report
from stages.evaluate.evaluation import load_evaluation_views, mean_psnr_db
from stages.scene import Splats, split_held_out
from stages.train import stage
from stages.train.settings import TrainSettings
from tests.small_scene import SmallScene, small_scene

FILE = Path("given.ply")  # the seed stage has read it


@pytest.fixture
def scene(tmp_path: Path) -> SmallScene:
    return small_scene(tmp_path)


def rows(splats: Splats) -> np.ndarray:
    """The parameters in an order of their own."""
    table = np.concatenate([array.reshape(len(splats), -1) for array in splats.arrays], axis=1)
    return table[np.lexsort(table.T)]


def test_no_steps_keep_every_splat_and_measure_what_the_file_is_worth(
    scene: SmallScene, tmp_path: Path
) -> None:
    unit = scene.splats.quaternions / np.linalg.norm(scene.splats.quaternions, axis=1)[:, None]
    start, report = replace(scene.splats, quaternions=unit), Report()
    settings = TrainSettings(splats=FILE, steps=0, sh_degree=1, max_splats=100, backend="cpu")
    inputs = {"sfm": scene.reconstruction, "seed": start}
    found = stage.run(inputs, settings, tmp_path, report).splats
    np.testing.assert_allclose(rows(found), rows(start), rtol=1e-6)
    assert found.draw_settings.antialias == start.draw_settings.antialias
    held = split_held_out(scene.reconstruction.views)[1]
    views = load_evaluation_views(tmp_path, held, start.draw_settings)
    assert report.metrics["psnr_db"] == pytest.approx(mean_psnr_db(start, views, "cpu"), abs=0.01)
    assert report.metrics["steps"] == 0


def test_steps_improve_given_splats_and_make_no_more_of_them(
    scene: SmallScene, tmp_path: Path
) -> None:
    rng = np.random.default_rng(3)
    sh = scene.splats.sh + rng.normal(0, 0.3, scene.splats.sh.shape).astype(np.float32)
    worse = replace(scene.splats, sh=sh)
    inputs = {"sfm": scene.reconstruction, "seed": worse}
    figures = []
    for steps in (0, 150):
        report = Report()
        settings = TrainSettings(splats=FILE, steps=steps, backend="cpu")
        splats = stage.run(inputs, settings, tmp_path, report).splats
        figures.append(report.metrics["psnr_db"])
        assert len(splats) <= len(worse)
        assert splats.sh_degree == 2
    assert figures[1] > figures[0] + 1


def test_densification_is_asked_for_and_has_no_smaller_cap_than_the_start(
    scene: SmallScene, tmp_path: Path
) -> None:
    inputs = {"sfm": scene.reconstruction, "seed": scene.splats}
    n, most = len(scene.splats), []
    for densify, cap in ((False, 400), (True, 400), (True, 100)):
        report = Report()
        settings = TrainSettings(
            splats=FILE, steps=150, backend="cpu", densify=densify, max_splats=cap
        )
        stage.run(inputs, settings, tmp_path, report)
        most.append(report.metrics["densified_splats"])
    assert most[0] <= n < most[1] <= 400
    assert 100 < most[2] == n


def test_more_degrees_of_colour_are_trained_where_they_are_asked_for(
    scene: SmallScene, tmp_path: Path
) -> None:
    inputs = {"sfm": scene.reconstruction, "seed": scene.splats.with_sh_degree(1)}
    settings = TrainSettings(splats=FILE, steps=30, backend="cpu", sh_degree=3)
    assert stage.run(inputs, settings, tmp_path, Report()).splats.sh_degree == 3
    still = replace(settings, steps=0)
    assert stage.run(inputs, still, tmp_path, Report()).splats.sh_degree == 1
