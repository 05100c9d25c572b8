"""The trade in sentences, each a figure that was measured."""

from __future__ import annotations

import math

from stages.base.text import counted
from stages.measure.bootstrap import Difference
from stages.measure.tradeoff.curves import Moment, Point, Trade, knee, time_to

CHEAP_DB = 0.1  # a loss that few would see
NO_TIMES = "Training kept no times (an older splat trained this run): `splat train` again has them."
NOT_FINE_TUNED = (
    "Splats were only taken away: nothing was fine-tuned afterwards. Training with so few from the "
    "start, or going on after the cut, usually loses less."
)


def about_time(trade: Trade) -> list[str]:
    """How soon training came near its last figure, and what the second half of the time bought."""
    moments = trade.moments
    if len(moments) < 2:
        return [NO_TIMES]
    last = moments[-1]
    told = [
        f"Training took {_seconds(last.seconds)} ({_seconds(last.cpu_seconds)} of CPU time) to "
        f"{last.psnr_db:.2f} dB, judged {len(moments)} times on the way."
    ]
    for below in (0.5, 0.1):
        wall, cpu = time_to(moments, below), time_to(moments, below, cpu=True)
        told.append(f"To within {below:g} dB of that: {_between(wall)} (CPU {_between(cpu)}).")
    half = _at(moments, last.seconds / 2)
    told.append(
        f"The second half of the time bought {last.psnr_db - half:.2f} dB. A run that is asked for "
        "fewer steps cools down sooner, and loses less than that."
    )
    return told


def about_formats(trade: Trade) -> list[str]:
    """What each step down in size costs, from the largest format that loses nothing."""
    whole = [point for point in trade.formats if point.change.mean > -1e-3]
    largest = next((p for p in trade.formats if p.label == ".ply"), trade.formats[-1])
    told = []
    if whole and whole[0].label != largest.label:
        told.append(
            f"{whole[0].label} is the smallest that loses nothing: {_share(whole[0], largest)} "
            f"of {largest.label}."
        )
    cheap = [point for point in trade.formats if point.change.mean > -CHEAP_DB]
    if cheap and cheap[0] not in whole:
        told.append(
            f"{cheap[0].label} is the smallest within {CHEAP_DB:g} dB: {_share(cheap[0], largest)} "
            f"of {largest.label}; it {costs(cheap[0].change)}."
        )
    smallest = trade.formats[0]
    if smallest not in (*whole[:1], *cheap[:1]):
        told.append(
            f"{smallest.label} is the smallest of all: {_share(smallest, largest)} of "
            f"{largest.label}; it {costs(smallest.change)}."
        )
    return told


def about_splats(trade: Trade) -> list[str]:
    """The chosen point, the knee and its neighbours."""
    points = trade.counts
    own = points[0]
    told = [f"This run has {own.splats:,} splats: {own.psnr_db:.2f} dB."]
    at = knee([float(p.splats) for p in points], [p.psnr_db for p in points])
    told.append(
        "No knee: every splat that is there earns its place about as well as the others."
        if at == 0
        else f"The knee is at {points[at].splats:,}: {_less(points[at], own)}."
    )
    for i in (at - 1, at + 1):
        if 0 < i < len(points):
            told.append(f"Beside it, {points[i].splats:,}: {_less(points[i], own)}.")
    half = min(points, key=lambda p: abs(math.log(p.splats / own.splats * 2)))
    if half is not own and abs(points.index(half) - at) > 1:
        told.append(f"Half: {_less(half, own)}.")
    return [*told, NOT_FINE_TUNED]


def about_drawing(trade: Trade) -> list[str]:
    own, *fewer = trade.counts
    told = [f"A picture of {trade.side_px} pixels takes {_ms(own)} here."]
    half = [p for p in fewer if p.frame_s and own.frame_s and p.frame_s <= own.frame_s / 2]
    if half:
        told.append(f"Twice as fast, {_ms(half[0])}: {_less(half[0], own)}.")
    return told


def about_photographs(trade: Trade) -> list[str]:
    worst, count = trade.worst, len(trade.scores)
    told = [f"The worst of {count} is no. {trade.scores.index(worst) + 1}, {worst.name}: "]
    told[0] += f"{worst.psnr_db:.2f} dB, {trade.own.psnr_db - worst.psnr_db:.2f} below the mean."
    if count < 8:
        told.append(f"Only {counted(count, 'photograph')} to judge by: intervals are wide.")
    return told


def costs(change: Difference) -> str:
    """ "costs 0.21 dB (95 %: 0.10 to 0.32)"."""
    what = "costs" if change.mean <= 0 else "gains"
    ends = sorted(_toward(end, change.mean) for end in (change.low, change.high))
    interval = f"95 %: {ends[0]:.2f} to {ends[1]:.2f}" if math.isfinite(ends[1]) else "one judge"
    return f"{what} {abs(change.mean):.2f} dB ({interval})"


def _toward(end: float, mean: float) -> float:
    """An end of the interval, counted in the direction of the mean."""
    return -end if mean <= 0 else end


def _less(point: Point, own: Point) -> str:
    return f"having {point.splats / own.splats:.0%} of the splats {costs(point.change)}"


def _share(point: Point, of: Point) -> str:
    size, whole = point.size_bytes or 0, of.size_bytes or 1
    return f"{size / 1e6:.2f} MB, {size / whole:.0%}"


def _at(moments: tuple[Moment, ...], seconds: float) -> float:
    """PSNR then, on straight lines between the figures."""
    import numpy as np

    return float(np.interp(seconds, [m.seconds for m in moments], [m.psnr_db for m in moments]))


def _between(ends: tuple[float, float]) -> str:
    first, last = ends
    return f"between {_seconds(first)} and {_seconds(last)}" if first else f"by {_seconds(last)}"


def _seconds(count: float) -> str:
    return f"{count:.1f} s" if count < 120 else f"{count / 60:.1f} min"


def _ms(point: Point) -> str:
    return f"{1000 * (point.frame_s or 0):.0f} ms"
