"""The verdict: what is good, usable and wrong, and what a photographer reads."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stages.base.stage import Report
from stages.evaluate.evaluation import load_evaluation_views
from stages.evaluate.verdict import GOOD, UNKNOWN, USABLE, WRONG, Fit, fits, verdict
from stages.scene import Camera, Splats, View, why_none_is_held_out
from stages.train.quality import report_verdict
from tests.scenes import join, splats
from tests.small_scene import small_scene


def of(*explained: float, behind: float = 0.0) -> list[Fit]:
    return [Fit(f"{i}.jpg", value, behind) for i, value in enumerate(explained)]


# Medians and extremes that were measured on captures whose pictures were looked at.
@pytest.mark.parametrize(
    ("held_out", "training", "grade", "said"),
    [
        (of(0.98, 0.96, 0.98, 0.99), of(0.98, 0.97), GOOD, "Good: "),  # a table in an office
        (of(*[0.98] * 12, 0.62), of(0.98, 0.98), GOOD, "Only 12.jpg is poor"),  # one in other light
        (of(0.94, 0.95, 0.87, behind=0.8), of(0.97, 0.94), USABLE, "behind the subject"),
        (of(0.92, 0.86), of(0.96, 0.93), USABLE, "1 of 2 held-out photographs is poor (1.jpg)"),
        (of(0.81, 0.69, 0.95), of(0.98, 0.96), USABLE, "2 of 3 held-out photographs are poor"),
        (of(0.92, 0.92), of(0.96, 0.96), USABLE, "more"),
        (of(0.62, 0.46, 0.61, 0.85), of(0.96, 0.97), WRONG, "smaller steps"),  # a street
        (of(0.75, 0.42, 0.86), of(0.78, 0.18), WRONG, "contradict each other"),  # false poses
        (of(-0.5, -1.0, -0.2), of(0.7, -0.5), WRONG, "stands still"),  # an object turned over
        ([], of(0.98), UNKNOWN, "No verdict"),
    ],
)
def test_the_grade_is_what_the_pictures_look_like(
    held_out: list[Fit], training: list[Fit], grade: str, said: str
) -> None:
    found = verdict(held_out, training)
    assert found.grade == grade
    assert said in found.text


def test_without_a_held_out_view_the_verdict_says_why() -> None:
    camera = Camera(4, 4, 4.0, 4.0, 2.0, 2.0, np.eye(4))
    few = [View("a.jpg", "a.jpg", camera)]
    wanted = [replace(view, role="train") for view in few]
    for views, said in (few, "too few photographs"), (wanted, "all photographs are trained on"):
        assert said in verdict([], of(0.98), why_none_is_held_out(views)).text


def test_the_true_splats_are_not_wrong_and_others_are(tmp_path: Path) -> None:
    scene = small_scene(tmp_path, noise=0.02)
    views = load_evaluation_views(tmp_path, scene.reconstruction.views, scene.splats.draw_settings)
    assert verdict(fits(scene.splats, views, "cpu"), []).grade != WRONG
    moved = replace(scene.splats, means=scene.splats.means[::-1].copy())
    assert verdict(fits(moved, views, "cpu"), []).grade == WRONG


def test_the_error_of_what_lies_behind_is_told_apart(tmp_path: Path) -> None:
    scene = small_scene(tmp_path, noise=0.0)
    views = load_evaluation_views(tmp_path, scene.reconstruction.views, scene.splats.draw_settings)
    walls = join(scene.splats, _shell(30.0))
    assert all(fit.behind > 0.9 for fit in fits(walls, views, "cpu"))


def _shell(radius: float) -> Splats:
    """Bright splats all around."""
    angle = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    means = radius * np.stack([np.cos(angle), 0 * angle, np.sin(angle)], axis=1)
    return splats(means, scales=3.0, opacities=0.9, rgb=(0.9, 0.9, 0.9))


def test_every_held_out_view_counts_in_the_verdict(tmp_path: Path) -> None:
    """25 are held out, and number 1 alone is poor."""
    scene = small_scene(tmp_path, views=25)
    drawn = scene.splats.with_antialias(True)
    views = list(load_evaluation_views(tmp_path, scene.reconstruction.views, drawn.draw_settings))
    inverted = [replace(view, pixels=255 - view.pixels) for view in views]
    one_poor = [*views[:1], inverted[1], *views[2:]]
    assert len(fits(drawn, one_poor, "cpu")) == 25
    report = Report()
    found = report_verdict(drawn, one_poor, scene.reconstruction, "cpu", report)
    assert found.grade == GOOD
    assert found.text.endswith(" Only 01.png is poor.")
    found = report_verdict(drawn, inverted, scene.reconstruction, "cpu", report)
    assert "25 of 25 held-out photographs are poor" in found.text


def test_contrast_and_a_bare_wall_are_no_fault(tmp_path: Path) -> None:
    """The same relative error is the same fit; noise on a bare wall is none."""
    scene = small_scene(tmp_path, noise=0.02)
    (view,) = load_evaluation_views(
        tmp_path, scene.reconstruction.views[:1], scene.splats.draw_settings
    )
    bare = replace(view, pixels=np.full_like(view.pixels, 4))
    nothing = scene.splats[:0]
    assert fits(nothing, [bare], "cpu")[0].explained > 0.7
