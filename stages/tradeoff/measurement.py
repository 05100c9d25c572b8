"""Measures the trade-offs of a run: time from its log, bytes by writing, splats by pruning."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from stages import formats
from stages.evaluate.coverage import patches_of
from stages.evaluate.evaluation import EvaluationView, Score, evaluate, image_renderer
from stages.formats.sog_quantisation import splats_to_write
from stages.formats.values import drop_undrawable
from stages.scene import QuantisedSplats, Splats, View, evenly_spaced, split_held_out
from stages.tradeoff.curves import (
    Coverage,
    HistoryPoint,
    OperatingPoint,
    Tradeoff,
    change_of,
    mean_db,
)

# Of the run's splats: those that pruning to a given number is measured at.
SHARES = (0.85, 0.7, 0.6, 0.5, 0.4, 0.3, 0.2, 0.1)
COVERAGE_VIEWS = 200  # at most, that coverage is measured by

ProgressCallback = Callable[[str], None]
PruneTo = Callable[[Splats, int], Splats]
"""Prunes splats to so many at most, as `splat prune --max-splats` does."""


@dataclass(frozen=True)
class TradeoffInputs:
    """What is measured.

    Args:
        splats: the run's last, in the coordinates of its cameras.
        held_out: views that quality is measured with.
        training: views that say how changes vary in the scene, see `intervals`.
        views: all views of the run.
        units: of lengths.
        backend: the rasteriser's name.
        history: as training logged it.
        exported: formats that the run wrote.
        quantised: the precision that was chosen for files; None where none was.
        prune_to: what `splat prune --max-splats` does; None measures no pruning.
        trained: the splats that pruning starts from; None for `splats`.
    """

    splats: Splats
    held_out: Sequence[EvaluationView]
    training: Sequence[EvaluationView]
    views: tuple[View, ...]
    units: str
    backend: str
    history: Sequence[dict[str, Any]] = ()
    exported: tuple[str, ...] = ()
    quantised: QuantisedSplats | None = None
    prune_to: PruneTo | None = None
    trained: Splats | None = None


def measure_tradeoff(inputs: TradeoffInputs, progress: ProgressCallback) -> Tradeoff:
    """Measure everything; held-out views decide nothing. Raises SplatError, as writers do."""
    splats = drop_undrawable(inputs.splats)[0]
    inputs = replace(inputs, splats=splats)
    progress("evaluating the run's splats")
    own_scores = _scores(inputs, splats)
    own = _point(inputs, "as it is", splats, own_scores, own_scores)
    progress("measuring the coverage of the capture")
    coverage = measure_coverage(splats, split_held_out(inputs.views)[0], inputs.backend)
    return Tradeoff(
        own=own,
        history=_history(inputs.history),
        formats=_formats(inputs, own_scores, progress),
        pruned=(own, *_pruned(inputs, own_scores, progress)),
        scores=tuple(score for score in own_scores[: len(inputs.held_out)] if score.counts),
        side_px=max(max(view.pixels.shape[:2]) for view in inputs.held_out),
        coverage=coverage,
        exported=inputs.exported,
    )


def _scores(inputs: TradeoffInputs, splats: Splats) -> list[Score]:
    """Of the held-out views, then of the training views."""
    draw = image_renderer(splats, inputs.backend)
    return evaluate(draw, inputs.held_out) + evaluate(draw, inputs.training)


def _point(
    inputs: TradeoffInputs,
    label: str,
    splats: Splats,
    scores: list[Score],
    own: list[Score],
    size: int | None = None,
) -> OperatingPoint:
    count = len(inputs.held_out)
    change = change_of(scores, own, count)
    return OperatingPoint(label, len(splats), mean_db(scores[:count]), change, size)


def _history(history: Sequence[dict[str, Any]]) -> tuple[HistoryPoint, ...]:
    return tuple(
        HistoryPoint(h["step"], h["splats"], h["seconds"], h["cpu_seconds"], h["psnr_db"])
        for h in history
        if "psnr_db" in h
    )


def _formats(
    inputs: TradeoffInputs, own: list[Score], progress: ProgressCallback
) -> tuple[OperatingPoint, ...]:
    """The splats in every format, written as export does and read back, smallest file first."""
    splats, points = inputs.splats, []
    with tempfile.TemporaryDirectory() as folder:
        for name, row in formats.FORMATS.items():
            progress(f"writing and evaluating .{name}")
            path = Path(folder) / f"scene.{name}"
            held = splats_to_write(row, inputs.quantised) if inputs.quantised else splats
            formats.write(path, held, units=inputs.units, views=inputs.views)
            size = row.size_bytes(path)
            read = formats.read(path)
            antialias = read.draw_settings.antialias
            read = replace(read, draw_settings=splats.draw_settings).with_antialias(antialias)
            for file in row.files(path):
                file.unlink()
            scores = own if _identical(read, splats) else _scores(inputs, read)
            points.append(_point(inputs, f".{name}", read, scores, own, size))
    return tuple(sorted(points, key=lambda point: point.size_bytes or 0))


def _identical(a: Splats, b: Splats) -> bool:
    """To the bit: then so are the pictures."""
    return all(
        x.shape == y.shape and x.tobytes() == y.tobytes()
        for x, y in zip(a.arrays, b.arrays, strict=True)
    )


def _pruned(
    inputs: TradeoffInputs, own: list[Score], progress: ProgressCallback
) -> list[OperatingPoint]:
    """Fewer and fewer splats, as `splat prune --max-splats` leaves them. Each number is reached
    from the one before, by the same rounds as from the trained splats."""
    points: list[OperatingPoint] = []
    splats = inputs.trained if inputs.trained is not None else inputs.splats
    if inputs.prune_to is None:
        return points
    for share in SHARES:
        count = round(share * len(inputs.splats))
        if not 0 < count < len(splats):
            continue
        progress(f"keeping {share:.0%} of the splats")
        splats = inputs.prune_to(splats, count)
        points.append(_point(inputs, f"{share:.0%}", splats, _scores(inputs, splats), own))
    return points


def measure_coverage(splats: Splats, training: Sequence[View], backend: str) -> Coverage:
    """What the training views show of `splats`."""
    chosen = evenly_spaced(training, COVERAGE_VIEWS)
    cameras = tuple(splats.draw_settings.camera(view.camera) for view in chosen)
    names = tuple(view.name for view in chosen)
    return Coverage(names, cameras, patches_of(splats, cameras, backend))
