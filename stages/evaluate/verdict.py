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
from numpy.typing import NDArray

from stages.base.text import listed
from stages.evaluate.evaluation import SIZES, EvaluationView
from stages.raster.definition import Rendering
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


@dataclass(frozen=True)
class _Drawn:
    """What is kept of a view that is drawn, since its photograph and its drawing would take too
    much memory for all views.

    Args:
        name: of the photograph.
        explained: see `Fit`.
        error: [P] of each compared pixel, squared.
        depth: [P] that is drawn there.
        see_through: [P] where hardly anything is drawn.
    """

    name: str
    explained: float
    error: NDArray[np.float32]
    depth: NDArray[np.float32]
    see_through: NDArray[np.bool_]

    @classmethod
    def of(cls, view: EvaluationView, rendering: Rendering) -> _Drawn:
        """Of a view that counts."""
        truth = view.image.astype(np.float64)
        valid = np.ones(truth.shape[:2], bool) if view.valid is None else view.valid
        error = ((np.clip(rendering.image, 0.0, 1.0) - truth) ** 2).mean(axis=2)[valid]
        variance = max(float(truth[valid].var(axis=0).mean()), LEAST_VARIANCE)
        see_through = (rendering.alpha < 0.5)[valid]
        explained = 1.0 - float(error.mean()) / variance
        small = error.astype(np.float32)
        return cls(view.name, explained, small, rendering.depth[valid], see_through)

    def fit(self, far: float) -> Fit:
        """far: depth from which on a pixel lies behind the subject."""
        behind = (self.depth > far) | self.see_through
        whole = float(self.error.sum(dtype=np.float64))
        share = float(self.error[behind].sum(dtype=np.float64)) / max(whole, 1e-12)
        return Fit(self.name, self.explained, share)


def fits(splats: Splats, views: Sequence[EvaluationView], backend: str) -> list[Fit]:
    """How well each of the views is drawn, at a quarter of its size. Splats for plain drawing are
    drawn at their own size and averaged: drawn small they are too large, which is no fault of the
    capture."""
    draw = renderer(splats, backend=backend)
    if not splats.draw_settings.antialias:
        draw = supersampled(draw, splats.draw_settings.side)
    middles, drawn = [], []
    for view in (full.scaled(SIZES["quarter"]) for full in views):
        rendering = draw(view.camera)
        height, width = view.pixels.shape[:2]
        middle = rendering.depth[height // 3 : -(-2 * height // 3), width // 3 : -(-2 * width // 3)]
        middles.append(middle[middle > 0])
        if view.counts:
            drawn.append(_Drawn.of(view, rendering))
    known = np.concatenate(middles) if middles else np.zeros(0)
    far = BEHIND * float(np.median(known)) if known.size else np.inf
    return [one.fit(far) for one in drawn]


def verdict(held_out: Sequence[Fit], training: Sequence[Fit], why_none: str = "") -> Verdict:
    """The verdict on a result, from fits of `held_out` and of some `training` views. why_none: the
    reason if none is held out."""
    if not held_out:
        return Verdict(UNKNOWN, f"No verdict: {why_none or 'no photograph is held out'}.")
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
