"""Merging of blocks: each block's splats in its own cell, with fine-tuned seams."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from stages.distributed.partition import Cell
from stages.evaluate.contribution import measure_contributions, squared_error
from stages.evaluate.evaluation import EvaluationView
from stages.formats.values import concatenate
from stages.scene import DrawSettings, Splats
from stages.train.finetune import FineTuner

REACH = 3.0  # standard deviations to which a splat extends
STEPS_PER_VIEW, MAX_STEPS = 24, 1200  # of fine-tuning the seams
REMOVED_FRACTIONS = (1.0, 0.5, 0.25, 0.1, 0.0)  # tried in turn, see `finetune_seams`


def initial_splats(seeds: Splats, coarse: Splats, cell: Cell, most: int) -> Splats:
    """The initial splats of a block: at most `most` of the seeds in its cell, evenly sampled, and
    outside its cell the coarse model of the scene."""
    degree = coarse.sh_degree
    inside = seeds.with_sh_degree(degree).take(cell.holds(seeds.means))
    if len(inside) > most:
        inside = inside.take(np.linspace(0, len(inside) - 1, most).round().astype(np.int64))
    return _concatenated([inside, coarse.take(~cell.holds(coarse.means))], coarse.draw_settings)


def most_visible(
    splats: Splats,
    own: NDArray[np.bool_],
    most: int,
    photographs: Sequence[EvaluationView],
    backend: str,
) -> NDArray[np.bool_]:
    """[N] the `most` splats of a block's `own` [N] whose removal would change its views most."""
    change = measure_contributions(splats, photographs, backend).picture_change
    rows = np.flatnonzero(own)
    kept = own.copy()
    kept[rows[np.argsort(change[rows], kind="stable")[: len(rows) - most]]] = False
    return kept


def merge_blocks(
    parts: Sequence[Splats], cells: Sequence[Cell], draw_settings: DrawSettings
) -> tuple[Splats, list[int]]:
    """(the splats whose centres lie in the cell of their part, part after part; how many of each).

    The background of each block's training is left out. All parts have the same origin.
    """
    own = [part.take(cell.holds(part.means)) for part, cell in zip(parts, cells, strict=True)]
    return _concatenated(own, draw_settings), [len(part) for part in own]


def _concatenated(parts: Sequence[Splats], draw_settings: DrawSettings) -> Splats:
    origin, place = parts[0].origin, parts[0].place
    return replace(concatenate(parts), origin=origin, place=place, draw_settings=draw_settings)


def at_seams(splats: Splats, counts: Sequence[int], cells: Sequence[Cell]) -> NDArray[np.bool_]:
    """[N] which splats of `merge_blocks` extend over the border of their cell."""
    reach = REACH * np.exp(splats.log_scales.max(axis=1).astype(np.float64))
    ends = np.cumsum([0, *counts])
    crossing = np.zeros(len(splats), bool)
    for cell, start, end in zip(cells, ends[:-1], ends[1:], strict=True):
        rows = slice(start, end)
        crossing[rows] = cell.border_distance(splats.means[rows]) < reach[rows]
    return crossing


def finetune_seams(
    splats: Splats,
    seam: NDArray[np.bool_],
    views: Sequence[EvaluationView],
    finetuner: FineTuner,
    backend: str,
) -> tuple[Splats, NDArray[np.bool_]]:
    """Remove superfluous splats at the seams, then fine-tune all splats.

    Two adjacent blocks may both have modelled the same surface near their border. Candidates are
    the splats of `seam` [N] whose removal alone would reduce the squared error of `views`. Removing
    all of them may increase it, so that the largest of `REMOVED_FRACTIONS` is chosen that does not,
    as measured by rendering.

    Returns: (the splats, [N] which were removed).
    """
    measured = measure_contributions(splats, views, backend)
    candidates = np.flatnonzero(seam & (measured.sse_change < 0))
    candidates = candidates[np.argsort(measured.sse_change[candidates], kind="stable")]
    for fraction in REMOVED_FRACTIONS:
        removed = np.zeros(len(splats), bool)
        removed[candidates[: int(fraction * len(candidates))]] = True
        if squared_error(splats.take(~removed), views, backend) <= measured.sse:
            break
    steps = min(MAX_STEPS, STEPS_PER_VIEW * len(views))
    return finetuner.finetune(splats.take(~removed), steps, measured.view_counts[~removed]), removed
