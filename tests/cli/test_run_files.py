"""A run's splats and the files in its export folder are measured and drawn in the same way, by the
cameras that training ended with."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from splatcli.commands import edit, verify, view
from stages import formats
from stages.proof.prover import cameras_for
from stages.run import pipeline, results
from stages.run.pipeline import Pipeline
from stages.scene import (
    DrawSettings,
    PrunedSplats,
    QuantisedSplats,
    RefinedCameras,
    Splats,
    TrainedSplats,
    View,
)
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
        "prune": PrunedSplats(splats),
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


@pytest.fixture
def refined(outputs: Outputs, tmp_path: Path) -> dict[str, View]:
    """The views of `outputs` by name, where training has refined cameras and masks one view."""
    cameras, masks = RefinedCameras({}, 1.1), {"01.png": tmp_path / "moved.png"}
    Image.fromarray(np.full((54, 72), 255, np.uint8)).save(masks["01.png"])
    splats = outputs["train"].splats
    outputs["train"] = TrainedSplats(splats, cameras=cameras, masks=masks)
    reconstruction = outputs["sfm"].with_cameras(cameras).with_masks(masks)
    return {view.name: view for view in reconstruction.views}


def assert_same(found: Iterable[View], wanted: dict[str, View]) -> None:
    by_name = {view.name: view for view in found}
    assert by_name.keys() == wanted.keys()
    assert {view.camera.fx for view in found} == {view.camera.fx for view in wanted.values()}
    assert by_name["01.png"].mask == wanted["01.png"].mask


def test_edit_measures_by_the_cameras_and_masks_of_training(refined: dict[str, View]) -> None:
    scene, _ = edit._load_scene(Path("run"), True)
    assert_same(scene.views, refined)
    masked = {view.name for view in scene.training_views if view.mask is not None}
    assert masked == {"01.png"}


def test_verify_and_view_draw_by_the_cameras_of_training(
    splat, refined: dict[str, View], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found: list[Iterable[View]] = []

    def keep_for_verify(splats: Splats, views: Iterable[View]) -> Any:
        found.append(views)
        return cameras_for(splats, tuple(views))

    def keep_for_view(*given: Any) -> dict[str, Any]:
        found.append(given[3])
        return {}

    monkeypatch.setattr(verify, "cameras_for", keep_for_verify)
    monkeypatch.setattr(view, "site", keep_for_view)
    splat("verify", "run/7-export/scene.html")
    run = Pipeline(Path("run"))
    view._items(None, run, results.newest_splats(run), tmp_path / "content.ply")
    found.append(results.views_of(run))
    assert len(found) == 3
    for views in found:
        assert_same(views, refined)


def test_before_training_the_views_are_those_of_the_capture(
    outputs: Outputs, refined: dict[str, View]
) -> None:
    Path("run/4-train/manifest.json").unlink()
    assert results.views_of(Pipeline(Path("run"))) == outputs["sfm"].views


@pytest.mark.parametrize("move", ["--move=1,0,0", "--rotate=x:180", "--scale=2"])
def test_moved_splats_are_not_written_where_the_cameras_of_a_run_are_taken_for_theirs(
    splat, outputs: Outputs, move: str
) -> None:
    result = splat("edit", "run", "run/7-export/moved.ply", move)
    assert result.exit_code == 2
    assert "edit-into-run" in result.stderr
    assert not Path("run/7-export/moved.ply").exists()
    assert splat("edit", "run", "moved.ply", move).exit_code == 0
    assert splat("edit", "run", "run/7-export/less.ply", "--degree", "0").exit_code == 0


def test_a_folder_of_ones_own_in_a_run_is_no_export_folder(splat, outputs: Outputs) -> None:
    Path("run/mine").mkdir()
    turned = splat("edit", "run", "run/mine/turned.ply", "--rotate=x:180")
    assert turned.exit_code == 0, turned.stderr
    assert results.run_around(Path("run/7-export/scene.html")) is not None
    for name in ("run/mine/turned.ply", "run/4-train/splats.npz"):
        assert results.run_around(Path(name)) is None
