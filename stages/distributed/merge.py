"""Blocks made one again: each gives what lies in its own cell, and seams are put right."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from stages.distributed.partition import Cell
from stages.measure.contribution import measure_contributions, squared_error
from stages.measure.evaluation import EvaluationView
from stages.scene import DrawSettings, Splats
from stages.training.finetune import FineTuner

REACH = 3.0  # standard deviations: as far as a splat is there
STEPS_A_PHOTOGRAPH, MOST_STEPS = 24, 1200  # of putting seams right
HARM_PARTS = (1.0, 0.5, 0.25, 0.1, 0.0)  # of what seems to harm, the first that drawing agrees to


def surrounded(seeds: Splats, coarse: Splats, cell: Cell, most: int) -> Splats:
    """What a block starts from: the seeds in its cell, at most as many, evenly chosen; and around
    it the coarse model of the whole."""
    degree = coarse.sh_degree
    inside = seeds.with_sh_degree(degree).take(cell.holds(seeds.means))
    if len(inside) > most:
        inside = inside.take(np.linspace(0, len(inside) - 1, most).round().astype(np.int64))
    return _joined([inside, coarse.take(~cell.holds(coarse.means))], coarse.draw_settings)


def shown_most(
    splats: Splats,
    own: NDArray[np.bool_],
    most: int,
    photographs: Sequence[EvaluationView],
    backend: str,
) -> NDArray[np.bool_]:
    """[N] as many of a block's splats `own` [N]: without those whose going changes the pictures of
    its photographs least."""
    change = measure_contributions(splats, photographs, backend).picture_change
    rows = np.flatnonzero(own)
    kept = own.copy()
    kept[rows[np.argsort(change[rows], kind="stable")[: len(rows) - most]]] = False
    return kept


def merged(
    parts: Sequence[Splats], cells: Sequence[Cell], draw_settings: DrawSettings
) -> tuple[Splats, list[int]]:
    """(the splats of each part whose centres lie in its cell, part after part; how many of each).

    What stood in for a block's surroundings is left behind. All parts have one origin.
    """
    own = [part.take(cell.holds(part.means)) for part, cell in zip(parts, cells, strict=True)]
    return _joined(own, draw_settings), [len(part) for part in own]


def _joined(parts: Sequence[Splats], draw_settings: DrawSettings) -> Splats:
    arrays = {
        name: np.concatenate([getattr(part, name) for part in parts])
        for name in (*("means", "quaternions", "log_scales"), "opacity_logits", "sh", "sh_degrees")
    }
    return replace(parts[0], draw_settings=draw_settings, **arrays)


def at_seams(splats: Splats, counts: Sequence[int], cells: Sequence[Cell]) -> NDArray[np.bool_]:
    """[N] which of the splats of `merged` reach over the border of their cell."""
    reach = REACH * np.exp(splats.log_scales.max(axis=1).astype(np.float64))
    ends = np.cumsum([0, *counts])
    found = np.zeros(len(splats), bool)
    for cell, start, end in zip(cells, ends[:-1], ends[1:], strict=True):
        rows = slice(start, end)
        found[rows] = cell.border_distance(splats.means[rows]) < reach[rows]
    return found


def put_right(
    splats: Splats,
    seam: NDArray[np.bool_],
    photographs: Sequence[EvaluationView],
    tuner: FineTuner,
    backend: str,
) -> tuple[Splats, NDArray[np.bool_]]:
    """(the splats without those at the seam that these photographs would be better without, tuned
    to them all for a while; [N] which went). Two blocks that each stood in for the other have put
    there twice what is there once; what only seems to be too much is missed when all of it goes,
    and drawing tells."""
    worth = measure_contributions(splats, photographs, backend)
    harm = np.flatnonzero(seam & (worth.sse_change < 0))
    harm = harm[np.argsort(worth.sse_change[harm], kind="stable")]
    for part in HARM_PARTS:
        gone = np.zeros(len(splats), bool)
        gone[harm[: int(part * len(harm))]] = True
        if squared_error(splats.take(~gone), photographs, backend) <= worth.sse:
            break
    steps = min(MOST_STEPS, STEPS_A_PHOTOGRAPH * len(photographs))
    return tuner.finetune(splats.take(~gone), steps, worth.view_counts[~gone]), gone
