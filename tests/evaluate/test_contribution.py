"""Contributions, compared with drawing without the splat or the SH coefficients."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stages.evaluate.contribution import colours_by_degree, measure_contributions, squared_error
from stages.evaluate.evaluation import image_renderer, load_evaluation_views
from stages.evaluate.selection import Removal
from stages.scene import Splats
from tests.formats.truth import colour, many_splats
from tests.small_scene import small_scene


def without(splats: Splats, row: int, degree: int, added: np.ndarray) -> Splats:
    """One splat cut to a degree, its colour moved."""
    degrees, shift = splats.sh_degrees.copy(), np.zeros((len(splats), 3))
    degrees[row], shift[row] = degree, added
    return Removal(np.zeros(len(splats), bool), degrees, shift, 0, 0.0).apply(splats)


def test_the_predicted_change_of_the_error_is_that_of_drawing_without_the_coefficients(
    tmp_path,
) -> None:
    scene = small_scene(tmp_path, views=4, n=60)
    # no colour at its end, where it is not linear any more
    splats = replace(scene.splats, sh=scene.splats.sh * np.float32(0.3))
    photographs = load_evaluation_views(
        scene.reconstruction.folder, scene.reconstruction.views, splats.draw_settings
    )
    contributions = measure_contributions(splats, photographs, "cpu")
    assert contributions.sse == pytest.approx(squared_error(splats, photographs, "cpu"), rel=1e-5)
    for row in (0, 10, 20):
        for degree in (0, 1):
            cut = without(splats, row, degree, contributions.truncated_colour[row, degree])
            change = squared_error(cut, photographs, "cpu") - contributions.sse
            assert contributions.truncated_sse_change[row, degree] == pytest.approx(
                change, rel=2e-3, abs=1e-5
            )
            plain = without(splats, row, degree, np.zeros(3))
            assert not np.array_equal(plain.sh[row, 0], cut.sh[row, 0])


@pytest.mark.parametrize("beyond", [0.0, 0.2])
def test_the_predicted_change_of_the_picture_is_that_of_drawing_without_the_splat(
    tmp_path, beyond: float
) -> None:
    """Also where the pictures continue beyond their edges."""
    scene = small_scene(tmp_path, views=4, n=60)
    photographs = load_evaluation_views(
        scene.reconstruction.folder, scene.reconstruction.views, scene.splats.draw_settings
    )
    contributions = measure_contributions(scene.splats, photographs, "cpu", beyond=beyond)
    assert (contributions.picture_change >= 0).all()
    draw = image_renderer(scene.splats, "cpu")
    cameras = [p.camera.continued(round(beyond * p.camera.width)) for p in photographs]
    for row in (0, 10, 20):
        fewer = image_renderer(scene.splats.take(np.arange(60) != row), "cpu")
        changes = [fewer(camera).astype(float) - draw(camera) for camera in cameras]
        wanted = sum(np.square(change).sum() for change in changes)
        assert contributions.picture_change[row] == pytest.approx(wanted, rel=2e-3, abs=1e-5)


def test_the_error_is_that_of_the_pictures_however_far_they_are_continued(tmp_path) -> None:
    scene = small_scene(tmp_path, views=4, n=60)
    photographs = load_evaluation_views(
        scene.reconstruction.folder, scene.reconstruction.views, scene.splats.draw_settings
    )
    alone, found = (
        measure_contributions(scene.splats, photographs, "cpu", beyond=beyond)
        for beyond in (0.0, 0.2)
    )
    # EWA takes what lies beyond 1.15 of a picture's angle for its edge: a few splats differ there
    assert found.sse == pytest.approx(alone.sse, rel=1e-3)
    np.testing.assert_allclose(found.psnr_db, alone.psnr_db, rtol=1e-3)
    assert (found.picture_change >= alone.picture_change * (1 - 1e-4)).all()
    assert (found.view_counts >= alone.view_counts).all()


def test_contributions_of_further_views_are_added(tmp_path) -> None:
    scene = small_scene(tmp_path, views=6, n=60)
    photographs = load_evaluation_views(
        scene.reconstruction.folder, scene.reconstruction.views, scene.splats.draw_settings
    )
    whole = measure_contributions(scene.splats, photographs, "cpu")
    others = measure_contributions(scene.splats, photographs[:4], "cpu")
    found = measure_contributions(scene.splats, photographs[4:], "cpu", others)
    for name in (
        "sse_change",
        "picture_change",
        "weight",
        "truncated_sse_change",
        "truncated_picture_change",
    ):
        np.testing.assert_allclose(getattr(found, name), getattr(whole, name), rtol=1e-9)
    assert (found.view_counts == whole.view_counts).all()
    assert found.sse == pytest.approx(whole.sse)
    assert (found.scene_depth == whole.scene_depth).all()
    assert (found.psnr_db == whole.psnr_db[4:]).all()


def test_colours_by_degree_are_the_definition_s() -> None:
    splats, centre = many_splats(6), np.array([0.3, -4.0, 1.0])
    found = colours_by_degree(splats, centre)
    for i in range(0, len(splats), 5):
        direction = splats.means[i] - centre
        for degree in range(splats.sh_degree + 1):
            sh = splats.sh[i].astype(float).copy()
            sh[(degree + 1) ** 2 :] = 0
            wanted = np.maximum(colour(sh, direction), 0)
            np.testing.assert_allclose(found[i, degree], wanted, atol=1e-6)
