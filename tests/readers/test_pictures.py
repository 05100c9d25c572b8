"""Web engines that we did not write draw our files as we do: upright, not mirrored, in colour."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stages import formats
from stages.editing import levels
from stages.evaluate.image_metrics import psnr
from stages.formats.values import sh_degrees_used
from stages.raster.draw import render
from stages.scene import Splats
from tests.readers.engines import (
    ENGINES,
    Engine,
    camera_for,
    served,
)
from tests.tolerances import ENGINE_DB
from tests.viewer.browser import Browser
from tests.viewer.screenshots import coloured_scene, views, wrong_versions

pytestmark = pytest.mark.slow
WORSE_DB = 5.0
LEVELS_DB = 33.0  # it chooses the level, and near is drawn at 39 dB, farther at 47 and 52


def scene() -> Splats:
    """Splats of degree 0 and 3 among each other, none brighter than white: some engines keep
    colours in 8 bits."""
    splats = coloured_scene()
    sh = splats.sh.copy()
    sh[:, 1:] *= 0.4
    sh[:, 0] *= 0.8
    return replace(splats, sh=sh, sh_degrees=sh_degrees_used(sh))


@pytest.mark.parametrize("name", ENGINES)
def test_engines_draw_what_render_draws(
    browser: Browser, packages: Path, tmp_path: Path, name: str
) -> None:
    splats = scene()
    with served(packages, tmp_path) as address:
        engine = Engine(browser, address, name)
        for suffix in ENGINES[name]:
            path = tmp_path / f"scene.{suffix}"
            formats.write(path, splats)
            assert engine.open(path.name) == len(splats), suffix
            # From another side, an engine sorts anew; that is the same for every format.
            for view in views()[: 2 if suffix == ENGINES[name][0] else 1]:
                ours = np.clip(render(splats, view.camera).image, 0, 1)
                theirs = engine.draw(camera_for(path, view.camera))
                right = psnr(theirs, ours)
                assert right > ENGINE_DB[name], (suffix, view.name)
                for what, wrong in wrong_versions(theirs).items():
                    assert psnr(wrong, ours) < right - WORSE_DB, (suffix, view.name, what)


def test_playcanvas_draws_levels_of_detail_from_three_distances(
    browser: Browser, packages: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Seen from farther, what it draws is less and less of the finest level, and looks the same."""
    splats = scene()
    monkeypatch.setattr(levels, "_FEWEST", len(splats) // 3)
    path = tmp_path / "lod-meta.json"
    levels.write(path, splats)
    assert (tmp_path / "1_0").is_dir()
    with served(packages, tmp_path) as address:
        engine = Engine(browser, address, "playcanvas")
        assert engine.open(path.name) == len(splats)
        view = views()[0].camera
        for away in (0.0, 6.0, 20.0):
            pose = view.world_to_camera.copy()
            pose[2, 3] += away
            camera = replace(view, world_to_camera=pose)
            ours = np.clip(render(splats, camera).image, 0, 1)
            assert ours.max() > 0.3
            found = psnr(engine.draw(camera_for(path, camera)), ours)
            assert found > LEVELS_DB, away
