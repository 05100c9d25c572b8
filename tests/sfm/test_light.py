"""Exposure and white balance, from points seen in several photographs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from stages.base.stage import Report
from stages.cameras.colmap import Observations
from stages.evaluate.evaluation import EvaluationView
from stages.scene import Camera
from stages.scene.light import NOISE_EV, spread_ev
from stages.sfm import light as light_module
from stages.sfm.light import LEAST_EXPLAINED, measure_light, with_light
from stages.sfm.reconstruction_files import load_reconstruction, save_reconstruction
from tests.small_scene import small_scene

SPOTS, VIEWS, CELL = 1200, 6, 8
COLUMNS = 40


def seen(light: np.ndarray) -> np.ndarray:
    """[..., 3] sRGB values of light, cut off at white."""
    bent = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light.clip(0) ** (1 / 2.4) - 0.055)
    return np.asarray(np.rint(bent.clip(0, 1) * 255) / 255)


def photographs(
    folder: Path,
    ev: np.ndarray,
    hidden: float = 0.1,
    shiny: bool = False,
    lit: float = 0.0,
) -> tuple:
    """Six photographs of cells of one colour each, [V, 3] EV lighter or darker; some cells show
    something else. Each spot is seen by half of them. lit: EV by which a lamp makes one side of the
    scene lighter from one photograph to the next, and the other side darker."""
    rng = np.random.default_rng(4)
    truth = rng.uniform(0.02, 0.6, (SPOTS, 3))
    positions = rng.normal(size=(SPOTS, 3))
    files, points, views, px = [], [], [], []
    for view in range(VIEWS):
        mine = truth * 2.0 ** (ev[view] + lit * (view - 2.5) * np.sign(positions[:, :1]))
        if shiny:
            mine[truth.mean(axis=1) > 0.3] *= 1.0 + 0.15 * view
        other = rng.random(SPOTS) < hidden
        mine[other] = rng.uniform(0, 1, (int(other.sum()), 3))
        picture = np.repeat(np.repeat(seen(mine).reshape(-1, COLUMNS, 3), CELL, 0), CELL, 1)
        files.append(folder / f"{view}.png")
        Image.fromarray(np.rint(picture * 255).astype(np.uint8)).save(files[-1])
        for spot in np.flatnonzero(rng.random(SPOTS) < 0.5):
            points.append(spot)
            views.append(view)
            px.append(CELL * (np.array([spot % COLUMNS, spot // COLUMNS]) + 0.5))
    return (
        files,
        positions,
        Observations(np.array(points, np.int32), np.array(views, np.int32), np.array(px)),
    )


def test_exposure_and_tint_are_measured_despite_outliers(tmp_path: Path) -> None:
    ev = np.array([[1, 1, 1], [-1, -1, -1], [0, 0, 0], [0.3, 0, -0.4], [0, 0, 0], [0.5, 0.5, 0.5]])
    found = measure_light(*photographs(tmp_path, ev))
    assert found.white_balance.supported
    assert_apart_as(found.light, ev)


def assert_apart_as(found: np.ndarray, truth: np.ndarray) -> None:
    """Equal but for the photograph that each channel is relative to."""
    away = found - truth
    np.testing.assert_allclose(
        away, np.broadcast_to(np.median(away, axis=0), away.shape), atol=0.06
    )


@pytest.mark.parametrize("shiny", [False, True])
def test_light_that_changed_explains_most_and_shine_alone_little(
    tmp_path: Path, shiny: bool
) -> None:
    random = np.random.default_rng(0)
    ev = np.log2(random.uniform(0.6, 1.6, (VIEWS, 1)) * random.uniform(0.9, 1.1, (VIEWS, 3)))
    found = measure_light(*photographs(tmp_path, ev, hidden=0.0, shiny=shiny))
    assert found.exposure.explained > LEAST_EXPLAINED + 0.2
    assert found.exposure.supported
    found = measure_light(*photographs(tmp_path, 0 * ev, hidden=0.0, shiny=True))
    assert found.exposure.spread_ev > NOISE_EV
    assert found.exposure.explained < LEAST_EXPLAINED
    assert not found.light.any()


def test_a_lamp_on_one_side_of_an_object_that_turns_is_no_exposure(tmp_path: Path) -> None:
    found = measure_light(*photographs(tmp_path, np.zeros((VIEWS, 3)), lit=0.3))
    assert found.exposure.disagreement_ev > found.exposure.spread_ev
    assert not found.light.any()


def test_exposure_is_corrected_without_the_white_balance_that_did_not_change(
    tmp_path: Path,
) -> None:
    ev = np.array([1.0, -1.0, 0.0, 0.3, 0.0, 0.5])[:, None] * np.ones(3)
    found = measure_light(*photographs(tmp_path, ev))
    assert found.exposure.supported
    assert not found.white_balance.supported
    assert np.ptp(found.light, axis=1).max() < 1e-9


def test_what_is_supported_is_stored(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ev = np.array([1.0, -1.0, 0.0, 0.3, 0.0, 0.5])[:, None] * np.ones(3)
    files, positions, observed = photographs(tmp_path, ev)
    read = None, SimpleNamespace(points=positions), observed
    monkeypatch.setattr(light_module, "read_model", lambda folder: read)
    whole = small_scene(tmp_path, VIEWS).reconstruction
    views = tuple(
        replace(view, image=file.name) for view, file in zip(whole.views, files, strict=True)
    )
    report = Report()
    found = with_light(replace(whole, views=views), report)
    assert report.metrics["exposure"]["supported"]
    lights = [view.light for view in found.views]
    assert None not in lights
    assert spread_ev(lights) > NOISE_EV
    save_reconstruction(tmp_path, found)
    loaded = load_reconstruction(tmp_path)
    assert [view.light for view in loaded.views] == lights


def test_even_light_is_within_a_cameras_noise(tmp_path: Path) -> None:
    found = measure_light(*photographs(tmp_path, np.zeros((VIEWS, 3))))
    assert not found.light.any()


def grey(folder: Path, levels: tuple[int, ...]) -> list[Path]:
    files = [folder / f"grey {number}.png" for number in range(len(levels))]
    for file, level in zip(files, levels, strict=True):
        Image.fromarray(np.full((200, 200, 3), level, np.uint8)).save(file)
    return files


def test_points_that_one_photograph_alone_shows_well_enough_say_nothing(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    points, views = (part.astype(np.int32) for part in np.divmod(np.arange(180), 3))
    seen_at = Observations(points, views, rng.uniform(20, 180, (180, 2)))
    found = measure_light(grey(tmp_path, (120, 5, 5)), rng.normal(size=(60, 3)), seen_at)
    assert not np.nan_to_num(found.light).any()


def test_a_part_of_the_scene_that_one_photograph_alone_shows_well_is_no_obstacle(
    tmp_path: Path,
) -> None:
    rng, files = np.random.default_rng(0), grey(tmp_path, (120, 125, 130))
    picture = np.full((200, 200, 3), 120, np.uint8)
    picture[:60, :60] = 0
    Image.fromarray(picture).save(files[0])
    diagonal = np.repeat(rng.uniform(-1, 1, 400)[:, None], 3, axis=1)
    positions = np.concatenate([diagonal, [[2.0, -2.0, 2.0]]])  # an octant of its own
    points, views = (part.astype(np.int32) for part in np.divmod(np.arange(1202), 3))
    px = rng.uniform(100, 180, (1202, 2))
    px[1200] = 20, 20
    found = measure_light(files, positions, Observations(points, views, px))
    assert (np.diff(found.light[:, 0]) > 0).all()


def test_a_photograph_without_shared_points_has_no_light(tmp_path: Path) -> None:
    files, positions, observed = photographs(tmp_path, np.zeros((VIEWS, 3)))
    others = observed.views != 2
    rest = Observations(*(column[others] for column in vars(observed).values()))
    found = measure_light(files, positions, rest).light
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
