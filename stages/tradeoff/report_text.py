"""The text of a trade-off report. Every figure in it was measured."""

from __future__ import annotations

import math
from pathlib import PurePosixPath

import numpy as np

from stages.base.text import counted
from stages.evaluate.coverage import (
    MIN_ANGLE_DEG,
    MIN_VIEWS,
    PoorRegion,
    poorly_covered_regions,
)
from stages.tradeoff.curves import Coverage, OperatingPoint, Tradeoff, time_to
from stages.tradeoff.intervals import OTHER_VIEWS, Difference

SMALL_LOSS_DB = 0.1  # that few people would see
NO_COURSE = "Training logged no course: it made no steps or few, or trained in blocks."
FINE_TUNED = (
    "The rest was fine-tuned after each removal, as `splat prune --max-splats` does. Training with "
    "so few splats from the start may lose less."
)
_MIN_REGION_SHARE = 0.01  # of the area that is seen
_POSITIONS = (
    ("upper left", "top", "upper right"),
    ("left", "middle", "right"),
    ("lower left", "bottom", "lower right"),
)


def about_time(tradeoff: Tradeoff) -> list[str]:
    """How soon training came near its last PSNR, and what the second half of the time gained."""
    history = tradeoff.history
    if len(history) < 2:
        return [NO_COURSE]
    last = history[-1]
    lines = [
        f"Training reached {last.psnr_db:.2f} dB after {_seconds(last.cpu_seconds)} of CPU time "
        f"({_seconds(last.seconds)} by the clock), with {len(history)} evaluations on the way."
    ]
    for below in (0.5, 0.1):
        lines.append(f"It was within {below:g} dB of that {_between(time_to(history, below))}.")
    times, psnr = [h.cpu_seconds for h in history], [h.psnr_db for h in history]
    half = float(np.interp(last.cpu_seconds / 2, times, psnr))
    lines.append(
        f"The second half of the time gained {last.psnr_db - half:.2f} dB. A run with fewer steps "
        "decays its learning rate sooner, and loses less than that."
    )
    return lines


def about_formats(tradeoff: Tradeoff) -> list[str]:
    """What each step down in size costs, from the smallest format that loses nothing."""
    lossless = [point for point in tradeoff.formats if point.change.mean > -1e-3]
    largest = next((p for p in tradeoff.formats if p.label == ".ply"), tradeoff.formats[-1])
    lines = []
    if lossless and lossless[0].label != largest.label:
        lines.append(
            f"{lossless[0].label} is the smallest that loses nothing: "
            f"{_share(lossless[0], largest)} of {largest.label}."
        )
    close = [point for point in tradeoff.formats if point.change.mean > -SMALL_LOSS_DB]
    if close and close[0] not in lossless:
        lines.append(
            f"{close[0].label} is the smallest within {SMALL_LOSS_DB:g} dB: "
            f"{_share(close[0], largest)} of {largest.label}; it {costs(close[0].change)}."
        )
    smallest = tradeoff.formats[0]
    if smallest not in (*lossless[:1], *close[:1]):
        lines.append(
            f"{smallest.label} is the smallest of all: {_share(smallest, largest)} of "
            f"{largest.label}; it {costs(smallest.change)}."
        )
    return lines


def about_splats(tradeoff: Tradeoff) -> list[str]:
    """The run itself, the knee and its neighbours."""
    points, at = tradeoff.pruned, tradeoff.knee
    own = points[0]
    lines = [f"This run has {own.splats:,} splats: {own.psnr_db:.2f} dB."]
    lines.append(
        "The curve has no knee: every splat contributes about as much as the others."
        if at == 0
        else f"The knee is at {points[at].splats:,}: {_fewer(points[at], own)}."
    )
    for i in (at - 1, at + 1):
        if 0 < i < len(points):
            lines.append(f"Next to it, {points[i].splats:,}: {_fewer(points[i], own)}.")
    half = min(points, key=lambda p: abs(math.log(p.splats / own.splats * 2)))
    if half is not own and abs(points.index(half) - at) > 1:
        lines.append(f"Half: {_fewer(half, own)}.")
    return [*lines, FINE_TUNED]


def about_photographs(tradeoff: Tradeoff) -> list[str]:
    worst, count = tradeoff.worst, len(tradeoff.scores)
    lines = [
        f"The worst of {count} is no. {tradeoff.scores.index(worst) + 1}, {worst.name}: "
        f"{worst.psnr_db:.2f} dB, {tradeoff.own.psnr_db - worst.psnr_db:.2f} below the mean."
    ]
    if count < 8:
        lines.append(f"With {counted(count, 'held-out view')}, intervals are wide.")
    return lines


def about_coverage(tradeoff: Tradeoff) -> list[str]:
    """Which surfaces too few views show, or over too small an angle."""
    coverage = tradeoff.coverage
    patches = coverage.patches
    if not len(patches.centres):
        return ["No training view shows any splat."]
    share = float(patches.area[patches.poorly_covered].sum() / patches.area.sum())
    lines = [
        f"Of the surfaces that the photographs show, {share:.0%} are poorly covered: seen by fewer "
        f"than {MIN_VIEWS} of the {len(coverage.names)} training views, or over less than "
        f"{MIN_ANGLE_DEG:g}°. Half are seen by {counted(patches.median_count, 'view')} or more."
    ]
    regions = poorly_covered_regions(patches)
    return lines + [_region(coverage, r) for r in regions if r.share >= _MIN_REGION_SHARE]


def _region(coverage: Coverage, region: PoorRegion) -> str:
    """Where a region is in the photograph that shows it best, and where to move from there."""
    camera, name = coverage.cameras[region.best], PurePosixPath(coverage.names[region.best]).stem
    pixels, _ = camera.project(region.centre[None])
    column, row = np.clip(3 * pixels[0] / (camera.width, camera.height), 0, 2).astype(int)
    seen = f"seen by {counted(region.views, 'view')}"
    if region.views > 1:
        seen += f", over {region.angle_deg:.0f}°"
    return (
        f"{_POSITIONS[row][column].capitalize()} in {name}: {seen}; {region.share:.0%} of all. "
        f"Photograph it from beside or above where {name} was taken, by a third of its distance."
    )


def costs(change: Difference) -> str:
    """ "costs 0.21 dB (other views, 90 %: 0.10 to 0.32)"."""
    sign = -1 if change.mean <= 0 else 1
    ends = sorted((sign * change.low, sign * change.high))
    interval = f"{OTHER_VIEWS}: {ends[0]:.2f} to {ends[1]:.2f}"
    if not change.shown:
        interval = f"of {counted(change.views, 'photograph')}"
    return f"{'costs' if sign < 0 else 'gains'} {abs(change.mean):.2f} dB ({interval})"


def _fewer(point: OperatingPoint, own: OperatingPoint) -> str:
    return f"keeping {point.splats / own.splats:.0%} of the splats {costs(point.change)}"


def _share(point: OperatingPoint, of: OperatingPoint) -> str:
    size, whole = point.size_bytes or 0, of.size_bytes or 1
    return f"{size / 1e6:.2f} MB, {size / whole:.0%}"


def _between(ends: tuple[float, float]) -> str:
    first, last = ends
    return f"between {_seconds(first)} and {_seconds(last)}" if first else f"by {_seconds(last)}"


def _seconds(count: float) -> str:
    return f"{count:.1f} s" if count < 120 else f"{count / 60:.1f} min"
