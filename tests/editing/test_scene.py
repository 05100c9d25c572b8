"""Operations on splats whose photographs are known: what they cost is told, wherever they go."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stages.editing.operations import apply_operations, prepare_operations
from stages.editing.scene import EditedScene
from stages.editing.syntax import ParsedOperation
from stages.evaluate.evaluation import EvaluationView
from stages.raster.draw import render
from stages.scene import Camera, DrawSettings, Splats, View, look_at
from tests import scenes


def room(n: int = 1500) -> Splats:
    r = np.random.default_rng(2)
    means = r.normal(0, 1, (n, 3))
    rgb = 0.5 + 0.4 * np.sin(3 * means)
    splats = scenes.splats(means, r.uniform(0.03, 0.1, (n, 3)), r.uniform(0.2, 0.9, n), rgb)
    sh = r.normal(0, 0.2, (n, 4, 3)).astype(np.float32)
    sh[:, 0] = splats.sh[:, 0]
    degrees = np.full(n, 1, np.uint8)
    return replace(splats, sh=sh, sh_degrees=degrees, draw_settings=DrawSettings(near=0.2))


def cameras(count: int = 6) -> list[Camera]:
    around = 2 * np.pi * np.arange(count) / count
    eyes = 5 * np.stack([np.sin(around), 0 * around - 0.2, -np.cos(around)], 1)
    poses = [look_at(eye, np.zeros(3)) for eye in eyes]
    return [Camera(96, 80, 90, 90, 48, 40, pose) for pose in poses]


def scene(splats: Splats) -> EditedScene:
    """Photographs are drawings of the splats."""
    photographs, views = [], []
    for number, camera in enumerate(cameras()):
        pixels = np.rint(255 * np.clip(render(splats, camera).image, 0, 1)).astype(np.uint8)
        photographs.append(EvaluationView(str(number), camera, pixels))
        views.append(View(str(number), "", camera))
    return EditedScene(splats, "metres", photographs, photographs[:2], tuple(views))


def after(start: EditedScene, *words: str) -> EditedScene:
    parsed = [ParsedOperation(*word.split(maxsplit=1)) for word in words]
    *_, last = apply_operations(start, prepare_operations(parsed, Path("scene.ply")))
    return last[1]


@pytest.mark.parametrize(
    "words",
    [
        ("rotate y:40",),
        ("scale 3", "move 1,2,3", "up 0,-1,0.4"),
        ("move 2000000,0,0", "rotate x:5"),
    ],
    ids=" ".join,
)
def test_a_scene_that_is_moved_as_a_whole_costs_nothing(words: tuple[str, ...]) -> None:
    start = scene(room())
    moved = after(start, *words)
    assert moved.psnr_db() == pytest.approx(start.psnr_db(), abs=0.3)
    assert (moved.psnr_db() or 0) > 45
    view = moved.placed_views()[1].camera
    drawn = render(moved.splats, view).image
    np.testing.assert_allclose(drawn, render(start.splats, cameras()[1]).image, atol=0.01)


def test_of_a_crop_the_share_of_the_pictures_is_told_and_no_psnr() -> None:
    splats = room()
    rng = np.random.default_rng(0)
    splats = replace(splats, means=np.sign(splats.means) + rng.normal(0, 0.2, splats.means.shape))
    start = scene(replace(splats, means=splats.means.astype(np.float32)))
    half = after(start, "crop box:-9,-9,-9,9,0,9")  # the cameras stand in its plane, about
    assert 0.4 < half.kept_share < 0.6
    assert half.psnr_db() is None
    quarter = after(half, "move 1,0,0", "drop box:1,-9,-9,9,9,9")
    assert quarter.kept_share == pytest.approx(half.kept_share / 2, rel=0.3)
    nearly = after(start, "keep opacity > 0.21")
    assert 0.97 < nearly.kept_share < 1
    assert nearly.psnr_db() is not None
    assert after(start, "crop sphere:0,0,0,50").kept_share == 1


def test_what_no_photograph_needs_close_before_a_camera_is_a_floater() -> None:
    clean = room()
    eye = cameras()[0].centre
    floater = scenes.splats([eye * 0.9], 0.01, 0.3).with_sh_degree(1)
    parts: dict[str, Any] = {
        name: np.concatenate([getattr(clean, name), getattr(floater, name)])
        for name in ("means", "quaternions", "log_scales", "opacity_logits", "sh", "sh_degrees")
    }
    start = replace(scene(clean), splats=replace(clean, **parts))
    found = after(start, "drop-floaters").splats
    distances = np.linalg.norm(found.means - eye, axis=1)
    assert distances.min() > 1
    assert len(found) > 0.95 * len(clean)
