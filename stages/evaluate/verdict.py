"""Is a result good? One sentence for a photographer.

Held-out and training views are compared with their photographs at a quarter of the size, where fine
texture, which no trainer reproduces everywhere, does not count. The measure is the share of a
photograph's variance that its drawing explains (the coefficient of determination, 1 at best).
Unlike PSNR it does not depend on contrast.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stages.base.text import listed
from stages.evaluate.evaluation import SIZES, EvaluationView
from stages.raster.draw import renderer, supersampled
from stages.scene import Splats

GOOD, USABLE, WRONG, UNKNOWN = "good", "usable", "wrong", "unknown"
TYPICAL = 0.93  # explained in the median held-out view of a good result
POOR = 0.9  # a view below is poor
RIGHT = 0.8  # explained in the median held-out view, unless the result is wrong
FEW = 0.125  # of the held-out views may be poor in a good result
BEHIND = 2.0  # x the median depth in the middle of the pictures; what is deeper lies behind
MOSTLY = 0.7  # of the error of poor views
LEAST_VARIANCE = 1e-3  # of a photograph: a bare wall is no fault


@dataclass(frozen=True)
class Fit:
    """How well one view is drawn.

    Args:
        name: of the photograph.
        explained: share of the photograph's variance, at most 1; may be negative.
        behind: share of the squared error that lies behind the subject.
    """

    name: str
    explained: float
    behind: float = 0.0


@dataclass(frozen=True)
class Verdict:
    """grade: GOOD, USABLE, WRONG or UNKNOWN. text: the sentence."""

    grade: str
    text: str


def fits(splats: Splats, views: Sequence[EvaluationView], backend: str) -> list[Fit]:
    """How well each of the views is drawn, at a quarter of its size. Splats for plain drawing are
    drawn at their own size and averaged: drawn small they are too large, which is no fault of the
    capture."""
    draw = renderer(splats, backend=backend)
    if not splats.draw_settings.antialias:
        draw = supersampled(draw, splats.draw_settings.side)
    drawn = [(view, draw(view.camera)) for view in (v.scaled(SIZES["quarter"]) for v in views)]
    middles = []
    for view, rendering in drawn:
        height, width = view.pixels.shape[:2]
        middle = rendering.depth[height // 3 : -(-2 * height // 3), width // 3 : -(-2 * width // 3)]
        middles.append(middle[middle > 0])
    known = np.concatenate(middles) if middles else np.zeros(0)
    far = BEHIND * float(np.median(known)) if known.size else np.inf
    found = []
    for view, rendering in drawn:
        truth = view.image.astype(np.float64)
        valid = np.ones(truth.shape[:2], bool) if view.valid is None else view.valid
        if not valid.any():
            continue
        error = ((np.clip(rendering.image, 0.0, 1.0) - truth) ** 2).mean(axis=2)[valid]
        variance = max(float(truth[valid].var(axis=0).mean()), LEAST_VARIANCE)
        behind = ((rendering.depth > far) | (rendering.alpha < 0.5))[valid]
        share = float(error[behind].sum() / max(error.sum(), 1e-12))
        found.append(Fit(view.name, 1.0 - float(error.mean()) / variance, share))
    return found


def verdict(held_out: Sequence[Fit], training: Sequence[Fit]) -> Verdict:
    """The verdict on a result, from fits of `held_out` and of some `training` views."""
    if not held_out:
        return Verdict(UNKNOWN, "No verdict: there are too few photographs to hold one out.")
    typical = float(np.median([fit.explained for fit in held_out]))
    poor = sorted((fit for fit in held_out if fit.explained < POOR), key=lambda fit: fit.explained)
    if typical >= TYPICAL and len(poor) <= FEW * len(held_out):
        aside = f" Only {poor[0].name} is poor." if len(poor) == 1 else ""
        few = f" {listed([fit.name for fit in poor], 3)} are poor." if len(poor) > 1 else ""
        return Verdict(
            GOOD, f"Good: photographs that took no part in training are reproduced.{aside}{few}"
        )
    grade, begin = (USABLE, "Usable") if typical >= RIGHT else (WRONG, "Wrong, do not use it")
    names = listed([fit.name for fit in poor], 3)
    count = f"{len(poor)} of {len(held_out)} held-out photographs"
    which = f"{count} {'is' if len(poor) == 1 else 'are'} poor ({names})" if poor else "it is soft"
    return Verdict(grade, f"{begin}: {which}. {_cause(poor, training)}")


def _cause(poor: Sequence[Fit], training: Sequence[Fit]) -> str:
    """Why views are poor, and what to do."""
    if training and float(np.mean([fit.explained < POOR for fit in training])) > FEW:
        return (
            "Photographs that it was trained on are not reproduced either: unless training was "
            "very short, they contradict each other. Something moved, the light changed, or "
            "cameras are in wrong places. Photograph a scene that stands still, in steady light, "
            "with more overlap."
        )
    if poor and float(np.mean([fit.behind for fit in poor])) > MOSTLY:
        return (
            "What lies behind the subject is poor: step back, and photograph it from several "
            "places, too."
        )
    return (
        "What lies between the photographs is not shown by enough of them: take more, in smaller "
        "steps, above all around these."
    )
