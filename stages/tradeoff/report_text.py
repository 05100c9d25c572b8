"""The text of a trade-off report. Every figure in it was measured."""

from __future__ import annotations

import math
from pathlib import PurePosixPath

import numpy as np
from numpy.typing import NDArray

from stages.base.text import counted
from stages.evaluate.coverage import MIN_ANGLE_DEG, MIN_VIEWS, CameraLayout, Gap, PoorRegion
from stages.tradeoff.bootstrap import FEWEST_SHOWN, Difference
from stages.tradeoff.curves import Coverage, OperatingPoint, Tradeoff, time_to

SMALL_LOSS_DB = 0.1  # that few people would see
NO_TIMES = "Training logged no times (an older version trained this run). Run `splat train` again."
FINE_TUNED = (
    "The rest was fine-tuned after each removal, as `splat prune --max-splats` does. Training with "
    "so few splats from the start may lose less."
)
_OVERHEAD_DEG, _DOWN_DEG = 65.0, 25.0
_SAME_AZIMUTH_DEG = 20.0
_SAME_ELEVATION_DEG = 10.0
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
        return [NO_TIMES]
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


def about_drawing(tradeoff: Tradeoff) -> list[str]:
    """How long a picture takes, and with how many splats it takes half as long."""
    own, *fewer = tradeoff.pruned
    kind = "of CPU time" if tradeoff.on_cpu else "on this GPU"
    lines = [f"A picture of {tradeoff.side_px} pixels takes {_ms(own)} {kind}."]
    half = [p for p in fewer if (p.draw_seconds or 0) <= (own.draw_seconds or 0) / 2]
    if half:
        lines.append(f"Half of that or less, {_ms(half[0])}: {_fewer(half[0], own)}.")
    return lines


def about_photographs(tradeoff: Tradeoff) -> list[str]:
    worst, count = tradeoff.worst, len(tradeoff.scores)
    lines = [
        f"The worst of {count} is no. {tradeoff.scores.index(worst) + 1}, {worst.name}: "
        f"{worst.psnr_db:.2f} dB, {tradeoff.own.psnr_db - worst.psnr_db:.2f} below the mean."
    ]
    if count < FEWEST_SHOWN:
        are = "is" if count == 1 else "are"
        lines.append(f"{counted(count, 'held-out view')} {are} too few for intervals.")
    elif count < 8:
        lines.append(f"There are only {counted(count, 'held-out view')}: intervals are wide.")
    return lines


def about_coverage(tradeoff: Tradeoff) -> list[str]:
    """What the views show too little of, and where one more photograph would help most."""
    coverage = tradeoff.coverage
    layout, patches = coverage.layout, coverage.patches
    if layout is None:
        return ["No training view shows any splat."]
    share = float(patches.area[patches.poorly_covered].sum() / patches.area.sum())
    lines = [
        f"Of the surfaces that the photographs show, {share:.0%} are poorly covered: seen by fewer "
        f"than {MIN_VIEWS} of the {len(coverage.names)} training views, or over less than "
        f"{MIN_ANGLE_DEG:g}°. Half are seen by {counted(patches.median_count, 'view')} or more."
    ]
    lines += [_gap(coverage, layout, number, gap) for number, gap in enumerate(coverage.gaps, 1)]
    if not coverage.gaps:
        lines.append("No direction that one could photograph from is far from every view.")
    regions = [region for region in coverage.regions if region.share >= _MIN_REGION_SHARE]
    lines += [_region(coverage, letter, r) for letter, r in zip("abc", regions, strict=False)]
    return [*lines, _floaters(coverage)]


def describe_direction(
    coverage: Coverage, layout: CameraLayout, direction: NDArray[np.float64]
) -> str:
    """A direction [3] around the middle by the photographs beside, around or opposite it."""
    elevation = float(layout.elevations_deg(direction))
    if layout.inward and elevation > _OVERHEAD_DEG:
        return "straight above"
    turns = (layout.azimuths_deg(layout.directions) - layout.azimuths_deg(direction)) % 360
    after, before = int(turns.argmin()), int(turns.argmax())
    away = min(float(turns[after]), 360 - float(turns[before]))
    near = after if turns[after] <= 360 - turns[before] else before
    hole = float(turns[after] + 360 - turns[before])
    if away <= _SAME_AZIMUTH_DEG:
        over = elevation - float(layout.elevations_deg(layout.directions[near]))
        where = f"{'above' if over > 0 else 'below'} {_name(coverage, near)}"
    elif hole <= 180:
        where = f"between {_name(coverage, before)} and {_name(coverage, after)}"
    else:
        where = (
            f"opposite {_name(coverage, int(np.abs(turns - 180).argmin()))}, in the {hole:.0f}° "
            f"from {_name(coverage, before)} round to {_name(coverage, after)}"
        )
    if not layout.inward:
        tilt = f", {abs(elevation):.0f}° {'up' if elevation > 0 else 'down'}"
        return where + (tilt if abs(elevation) > _SAME_ELEVATION_DEG else "")
    down = elevation > _DOWN_DEG
    return where + (f", looking down {elevation:.0f}°" if down else ", held level")


def _gap(coverage: Coverage, layout: CameraLayout, number: int, gap: Gap) -> str:
    direction = describe_direction(coverage, layout, gap.direction)
    missing = "sees the middle of the scene from there" if layout.inward else "looks there"
    advice = "Take one from there, if possible." if layout.inward else "Turn there."
    return (
        f"Gap {number}, {direction}: no photograph {missing}; the nearest, "
        f"{_name(coverage, gap.nearest)}, is {gap.angle_deg:.0f}° away. {advice}"
    )


def _region(coverage: Coverage, letter: str, region: PoorRegion) -> str:
    """Where a region is in the photograph that shows it best, and where to move from there."""
    camera, name = coverage.cameras[region.best], _name(coverage, region.best)
    pixels, _ = camera.project(region.centre[None])
    column, row = np.clip(3 * pixels[0] / (camera.width, camera.height), 0, 2).astype(int)
    seen = f"seen by {counted(region.views, 'view')}"
    if region.views > 1:
        seen += f", over {region.angle_deg:.0f}°"
    return (
        f"Region {letter}, {_POSITIONS[row][column]} in {name}: {seen}; {region.share:.0%} of all. "
        f"Photograph it from beside or above where {name} was taken, by a third of its distance."
    )


def _floaters(coverage: Coverage) -> str:
    if not len(coverage.floaters):
        return "There are no floaters close to a camera."
    eyes = np.array([camera.centre for camera in coverage.cameras])
    nearest = np.linalg.norm(coverage.floaters[:, None] - eyes, axis=2).argmin(axis=1)
    first, count = np.unique(nearest, return_counts=True)
    order = np.argsort(-count, kind="stable")[:3]
    named = ", ".join(f"{_name(coverage, int(first[i]))} ({count[i]})" for i in order)
    many = counted(len(coverage.floaters), "splat is a floater", "splats are floaters")
    return f"{many} close to a camera, most of them near {named}."


def _name(coverage: Coverage, number: int) -> str:
    return PurePosixPath(coverage.names[number]).stem


def costs(change: Difference) -> str:
    """ "costs 0.21 dB (95 %: 0.10 to 0.32)"."""
    sign = -1 if change.mean <= 0 else 1
    ends = sorted((sign * change.low, sign * change.high))
    interval = f"95 %: {ends[0]:.2f} to {ends[1]:.2f}"
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


def _ms(point: OperatingPoint) -> str:
    return f"{1000 * (point.draw_seconds or 0):.0f} ms"
