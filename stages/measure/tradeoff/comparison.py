"""Two runs of the same photographs, judged side by side."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from stages.base.errors import Family, SplatError
from stages.base.text import counted
from stages.measure.bootstrap import Difference, paired_difference
from stages.measure.evaluation import (
    EvaluationView,
    Score,
    evaluate,
    image_renderer,
    load_evaluation_views,
)
from stages.measure.tradeoff.curves import change_db
from stages.scene import Reconstruction, Splats, View, split_held_out


@dataclass(frozen=True)
class Candidate:
    """One of the two runs. facts: what else is worth a line, by name, in words."""

    name: str
    splats: Splats
    reconstruction: Reconstruction
    backend: str
    fact_rows: dict[str, str]

    @property
    def held_out(self) -> dict[str, View]:
        """By name: views that this run did not learn from."""
        return {view.name: view for view in split_held_out(self.reconstruction.views)[1]}

    def photographs(self, names: Sequence[str], side_px: int) -> tuple[EvaluationView, ...]:
        """Each from where this run saw it. Raises SplatError."""
        views, draw_settings = self.held_out, replace(self.splats.draw_settings, side=side_px)
        chosen = [views[n] for n in names]
        return tuple(load_evaluation_views(self.reconstruction.folder, chosen, draw_settings))


@dataclass(frozen=True)
class Pairing:
    """scores of both, photograph by photograph. psnr, ssim: of the second less the first.
    side_px: longer side of every picture."""

    sides: tuple[Candidate, Candidate]
    photographs: tuple[tuple[EvaluationView, ...], tuple[EvaluationView, ...]]
    scores: tuple[tuple[Score, ...], tuple[Score, ...]]
    psnr: Difference
    ssim: Difference
    side_px: int


def compare_runs(first: Candidate, second: Candidate) -> Pairing:
    """Judge both on the photographs that neither learnt from, at the smaller size of the two.

    Each photograph is seen as its own run undistorted and placed it. Raises SplatError
    (compare-nothing-in-common)."""
    names = sorted(first.held_out.keys() & second.held_out.keys())
    if not names:
        raise SplatError(
            "compare-nothing-in-common",
            given=f"No photograph is held out of both {first.name} and {second.name}.",
            wanted="Photographs that neither learnt from, to judge both by.",
            hint="Make both runs of the same photographs, four or more.",
            family=Family.USAGE,
        )
    both = (first, second)
    side_px = min(_side(one, name) for one in both for name in names)
    photographs = (first.photographs(names, side_px), second.photographs(names, side_px))
    found_a, found_b = (
        tuple(evaluate(image_renderer(one.splats, one.backend), seen))
        for one, seen in zip(both, photographs, strict=True)
    )
    ssim = np.array([b.ssim - a.ssim for a, b in zip(found_a, found_b, strict=True)])
    return Pairing(
        both,
        photographs,
        (found_a, found_b),
        change_db(found_b, found_a),
        paired_difference(ssim),
        side_px,
    )


def _side(one: Candidate, name: str) -> int:
    camera = one.splats.draw_settings.camera(one.held_out[name].camera)
    return max(camera.width, camera.height)


def verdict_lines(pairing: Pairing) -> list[str]:
    """What may be said of the two."""
    change, (a, b) = pairing.psnr, pairing.sides
    interval, ssim = (
        f"95 %: {d.low:+.{digits}f} to {d.high:+.{digits}f}" if d.photographs > 1 else "one judge"
        for d, digits in ((change, 2), (pairing.ssim, 4))
    )
    judges = counted(change.photographs, "held-out photograph")
    return [
        f"{b.name} against {a.name}: {change.mean:+.2f} dB ({interval}): {change.verdict}.",
        f"SSIM: {pairing.ssim.mean:+.4f} ({ssim}): {pairing.ssim.verdict}.",
        f"Judged on {judges}, {pairing.side_px} pixels large. One run each: whether the same "
        "settings would win again with another seed is not in the interval.",
    ]


def distinct_name(folder: Path, other: Path) -> str:
    """A run folder's own name, with its parent's where the other is called the same."""
    here, there = folder.absolute(), other.absolute()
    return here.name if here.name != there.name else f"{here.parent.name}/{here.name}"
