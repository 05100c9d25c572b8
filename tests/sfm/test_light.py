"""Exposure and white balance, from points seen in several photographs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from stages.base.stage import Report
from stages.cameras.colmap import Observations
from stages.evaluate.evaluation import EvaluationView, load_evaluation_view
from stages.scene import TRANSPARENT, Camera, View
from stages.scene.light import BRIGHT, NOISE_EV, powers_of_radius, spread_ev
from stages.sfm import light as light_module
from stages.sfm.light import LEAST_EXPLAINED, measure_light, with_light
from stages.sfm.reconstruction_files import load_reconstruction, save_reconstruction
from tests.small_scene import small_scene

SPOTS, VIEWS, CELL = 1200, 6, 8
COLUMNS = 40
CAMERA = Camera(CELL * COLUMNS, CELL * SPOTS // COLUMNS, 400.0, 400.0, 160.0, 120.0, np.eye(4))
VIGNETTING = (0.5, 0.2, 0.1)


def centres(spots: np.ndarray) -> np.ndarray:
    """[..., 2] pixels of the centres of cells."""
    return CELL * (np.stack([spots % COLUMNS, spots // COLUMNS], axis=-1) + 0.5)


def vignetting_at(place: np.ndarray) -> np.ndarray:
    """EV by which a place [..., 2] from the centre is darker."""
    return powers_of_radius((place**2).sum(axis=-1)) @ np.array(VIGNETTING)


def seen(light: np.ndarray) -> np.ndarray:
    """[..., 3] sRGB values of light, cut off at white."""
    bent = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light.clip(0) ** (1 / 2.4) - 0.055)
    return np.asarray(np.rint(bent.clip(0, 1) * 255) / 255)


def photographs(
    folder: Path,
    ev: np.ndarray,
    hidden: float = 0.1,
    shiny: bool = False,
    darker: Callable[[np.ndarray], np.ndarray] | None = None,
    lit: float = 0.0,
) -> tuple:
    """Six photographs of cells of one colour each, [V, 3] EV lighter or darker; some cells show
    something else. Each spot is seen by half of them, at the same place or, with `darker`, at
    different ones. darker: EV by which a place [..., 2] from the centre, in half diagonals, is.
    lit: EV by which a lamp makes one side of the scene lighter from one photograph to the next, and
    the other side darker."""
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
        place = np.arange(SPOTS)
        if darker is not None:
            place = rng.permutation(SPOTS)
            mine *= 2.0 ** -darker((centres(place) - (160.0, 120.0)) / 200.0)[:, None]
        cells = np.empty((SPOTS, 3))
        cells[place] = seen(mine)
        picture = np.repeat(np.repeat(cells.reshape(-1, COLUMNS, 3), CELL, 0), CELL, 1)
        files.append(folder / f"{view}.png")
        Image.fromarray(np.rint(picture * 255).astype(np.uint8)).save(files[-1])
        for spot in np.flatnonzero(rng.random(SPOTS) < 0.5):
            points.append(spot)
            views.append(view)
            px.append(centres(place[spot]))
    return (
        files,
        [CAMERA] * VIEWS,
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
    files, _, positions, observed = photographs(tmp_path, ev)
    read = None, SimpleNamespace(points=positions), observed
    monkeypatch.setattr(light_module, "read_model", lambda folder: read)
    whole = small_scene(tmp_path, VIEWS).reconstruction
    views = tuple(
        replace(view, image=file.name) for view, file in zip(whole.views, files, strict=True)
    )
    report = Report()
    found = with_light(replace(whole, views=views), report)
    assert report.metrics["exposure"]["supported"]
    found = replace(found, views=(replace(found.views[0], vignetting=VIGNETTING), *found.views[1:]))
    lights = [view.light for view in found.views]
    assert None not in lights
    assert spread_ev(lights) > NOISE_EV
    save_reconstruction(tmp_path, found)
    loaded = load_reconstruction(tmp_path)
    assert [view.light for view in loaded.views] == lights
    assert [view.vignetting for view in loaded.views] == [VIGNETTING] + [None] * (VIEWS - 1)


def test_even_light_is_within_a_cameras_noise(tmp_path: Path) -> None:
    found = measure_light(*photographs(tmp_path, np.zeros((VIEWS, 3))))
    assert not found.light.any()
    assert not found.vignetting.any()


def test_a_photograph_without_shared_points_has_no_light(tmp_path: Path) -> None:
    files, cameras, positions, observed = photographs(tmp_path, np.zeros((VIEWS, 3)))
    others = observed.views != 2
    rest = Observations(*(column[others] for column in vars(observed).values()))
    found = measure_light(files, cameras, positions, rest).light
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


def test_vignetting_is_measured_apart_from_exposure(tmp_path: Path) -> None:
    ev = np.array([[1, 1, 1], [-1, -1, -1], [0, 0, 0], [0.3, 0, -0.4], [0, 0, 0], [0.5, 0.5, 0.5]])
    found = measure_light(*photographs(tmp_path, ev, darker=vignetting_at))
    radii = np.linspace(0, 0.9, 10)[:, None] * (1.0, 0.0)
    measured = powers_of_radius((radii**2).sum(axis=1)) @ found.vignetting[0]
    np.testing.assert_allclose(measured, vignetting_at(radii), atol=0.06)
    assert_apart_as(found.light, ev)
    assert found.vignetting_explained > 0.5


def test_shading_of_one_side_is_no_vignetting(tmp_path: Path) -> None:
    """Lower halves are darker outwards, as of an object that shades the ground."""
    given = photographs(
        tmp_path,
        np.zeros((VIEWS, 3)),
        darker=lambda place: vignetting_at(place) * (place[:, 1] > 0),
    )
    assert not measure_light(*given).vignetting.any()


def test_a_camera_with_few_photographs_has_no_vignetting(tmp_path: Path) -> None:
    files, _, *observed = photographs(tmp_path, np.zeros((VIEWS, 3)), darker=vignetting_at)
    cameras = [replace(CAMERA, fx=400.0 + number // 3) for number in range(VIEWS)]
    assert not measure_light(files, cameras, *observed).vignetting.any()


@pytest.mark.parametrize("outside", ["", TRANSPARENT])
def test_a_photograph_without_its_vignetting(tmp_path: Path, outside: str) -> None:
    rng = np.random.default_rng(0)
    alpha = rng.uniform(0.2, 1.0, (CAMERA.height, CAMERA.width, 1)) if outside else np.ones(1)
    light = rng.uniform(0.02, 0.5, (CAMERA.height, CAMERA.width, 3))
    y, x = np.mgrid[: CAMERA.height, : CAMERA.width] + 0.5
    darker = vignetting_at(np.stack([x - CAMERA.cx, y - CAMERA.cy], axis=-1) / 200.0)
    picture = seen(light * 2.0 ** -darker[..., None]) * alpha
    picture[120, 160], picture[0, 0] = 1.0, 0.95  # saturated, and nearly so in the dark corner
    Image.fromarray(np.rint(picture * 255).astype(np.uint8)).save(tmp_path / "a.png")
    if outside:
        mask = np.rint(alpha[..., 0] * 255).astype(np.uint8)
        Image.fromarray(mask).save(tmp_path / "m.png")
    view = View("a", "a.png", CAMERA, mask="m.png" if outside else "", outside=outside)
    view = replace(view, vignetting=VIGNETTING)
    found = load_evaluation_view(tmp_path, view, CAMERA, vignetting=True).image
    assert found[120, 160].min() == 1.0
    assert 0.95 < found[0, 0].max() < BRIGHT
    others = np.ones(found.shape[:2], bool)
    others[120, 160] = others[0, 0] = False
    assert np.abs(found - seen(light) * alpha)[others].max() < 0.012
    unchanged = load_evaluation_view(tmp_path, view, CAMERA).image
    assert np.abs(unchanged - picture).max() <= 0.5 / 255 + 1e-6
