"""Exposure and white balance, from points seen in several photographs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from stages.base.stage import Report
from stages.measure.evaluation import EvaluationView
from stages.scene import Camera
from stages.scene.light import LEAST_EXPLAINED, NOISE_EV, spread_ev
from stages.structure import light as light_module
from stages.structure.light import measure_light, with_light
from stages.structure.reconstruction_files import load_reconstruction, save_reconstruction
from tests.small_scene import small_scene

SPOTS, VIEWS, CELL = 300, 6, 8
COLUMNS = 20


def seen(light: np.ndarray) -> np.ndarray:
    """[..., 3] sRGB values of light, cut off at white."""
    bent = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light.clip(0) ** (1 / 2.4) - 0.055)
    return np.asarray(np.rint(bent.clip(0, 1) * 255) / 255)


def photographs(folder: Path, ev: np.ndarray, hidden: float = 0.1, shiny: bool = False) -> tuple:
    """Six photographs of cells of one colour each, [V, 3] EV lighter or darker; some cells show
    something else. Each spot is seen by half of them."""
    rng = np.random.default_rng(4)
    truth = rng.uniform(0.02, 0.6, (SPOTS, 3))
    files, points, views, px = [], [], [], []
    for view in range(VIEWS):
        mine = truth * 2.0 ** ev[view]
        if shiny:
            mine[truth.mean(axis=1) > 0.3] *= 1.0 + 0.15 * view
        other = rng.random(SPOTS) < hidden
        mine[other] = rng.uniform(0, 1, (int(other.sum()), 3))
        cells = seen(mine).reshape(-1, COLUMNS, 3)
        picture = np.repeat(np.repeat(cells, CELL, 0), CELL, 1)
        files.append(folder / f"{view}.png")
        Image.fromarray(np.rint(picture * 255).astype(np.uint8)).save(files[-1])
        for spot in np.flatnonzero(rng.random(SPOTS) < 0.5):
            points.append(spot)
            views.append(view)
            row, column = divmod(int(spot), COLUMNS)
            px.append((CELL * (column + 0.5), CELL * (row + 0.5)))
    return files, np.array(points, np.int32), np.array(views, np.int32), np.array(px)


def test_exposure_and_tint_are_measured_despite_outliers(tmp_path: Path) -> None:
    ev = np.array([[1, 1, 1], [-1, -1, -1], [0, 0, 0], [0.3, 0, -0.4], [0, 0, 0], [0.5, 0.5, 0.5]])
    found, _ = measure_light(*photographs(tmp_path, ev))
    np.testing.assert_allclose(found, ev - np.median(ev, axis=0), atol=0.06)


@pytest.mark.parametrize("shiny", [False, True])
def test_light_that_changed_explains_most_and_shine_alone_little(
    tmp_path: Path, shiny: bool
) -> None:
    random = np.random.default_rng(0)
    ev = np.log2(random.uniform(0.6, 1.6, (VIEWS, 1)) * random.uniform(0.9, 1.1, (VIEWS, 3)))
    _, explained = measure_light(*photographs(tmp_path, ev, hidden=0.0, shiny=shiny))
    assert explained > LEAST_EXPLAINED + 0.2
    found, explained = measure_light(*photographs(tmp_path, 0 * ev, hidden=0.0, shiny=True))
    assert spread_ev([tuple(row) for row in found.tolist()]) > NOISE_EV
    assert explained < LEAST_EXPLAINED


def test_light_is_stored_although_it_explains_little(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files, *observed = photographs(tmp_path, np.zeros((VIEWS, 3)), hidden=0.0, shiny=True)
    observed_points, observing_views, observed_px = observed
    model = SimpleNamespace(
        observed_points=observed_points, observing_views=observing_views, observed_px=observed_px
    )
    monkeypatch.setattr(light_module, "read_model", lambda folder: (None, model))
    whole = small_scene(tmp_path, VIEWS).reconstruction
    views = tuple(
        replace(view, image=file.name) for view, file in zip(whole.views, files, strict=True)
    )
    found = with_light(replace(whole, views=views), Report())
    lights = [view.light for view in found.views]
    assert None not in lights
    assert found.light_explained < LEAST_EXPLAINED
    save_reconstruction(tmp_path, found)
    loaded = load_reconstruction(tmp_path)
    assert loaded.light_explained == found.light_explained
    assert [view.light for view in loaded.views] == lights


def test_even_light_is_within_a_cameras_noise(tmp_path: Path) -> None:
    found, _ = measure_light(*photographs(tmp_path, np.zeros((VIEWS, 3))))
    assert spread_ev([tuple(row) for row in found.tolist()]) < NOISE_EV


def test_a_photograph_without_shared_points_has_no_light(tmp_path: Path) -> None:
    files, points, views, px = photographs(tmp_path, np.zeros((VIEWS, 3)))
    alone = views != 2
    found, _ = measure_light(files, points[alone], views[alone], px[alone])
    assert np.isnan(found[2]).all()
    assert np.isfinite(np.delete(found, 2, 0)).all()


@pytest.mark.parametrize("light", [(1.0, 1.0, 1.0), (-0.8, 0.3, 0.1)])
def test_a_photograph_is_brought_back_to_what_the_median_one_shows(
    light: tuple[float, float, float],
) -> None:
    rng = np.random.default_rng(0)
    truth = rng.uniform(0.02, 0.5, (20, 30, 3))
    where = Camera(30, 20, 30.0, 30.0, 15.0, 10.0, np.eye(4))
    as_taken = np.rint(seen(truth * 2.0 ** np.array(light)) * 255).astype(np.uint8)
    even = EvaluationView("a", where, as_taken).in_median_light(light)
    kept = even.valid
    assert kept is not None
    assert kept.mean() > 0.3
    assert np.abs(even.image - seen(truth))[kept].max() < 0.012
