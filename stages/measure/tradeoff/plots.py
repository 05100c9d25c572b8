"""The curves as pictures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from stages.measure.plots import BLUE, GREY, ORANGE, new_plot, write_plot
from stages.measure.tradeoff.curves import Point, Trade, knee
from stages.measure.tradeoff.plan_view import plan_view

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_PSNR = "held-out PSNR (dB)"
_CLOSE, _CLOSE_DB = 1.4, 0.02  # of sizes, and of PSNR: what labels need to stand apart


def write_plots(folder: Path, trade: Trade) -> list[Path]:
    """PNGs; none of time where training logged none. Raises SplatError."""
    drawn = {
        "formats": _formats(trade),
        "splats": _splats(trade),
        "drawing": _drawing(trade),
        "photographs": _photographs(trade),
    }
    if trade.thin.ring is not None:
        drawn["coverage"] = plan_view(trade.thin)
    if len(trade.moments) > 1:
        drawn = {"time": _time(trade), **drawn}
    paths = []
    for name, figure in drawn.items():
        paths.append(folder / f"{name}.png")
        write_plot(paths[-1], figure)
    return paths


def _time(trade: Trade) -> Figure:
    figure, axes = new_plot("Quality against training time", "seconds", _PSNR)
    quality = [m.psnr_db for m in trade.moments]
    axes.plot([m.seconds for m in trade.moments], quality, "o-", color=BLUE, ms=4, label="wall")
    cpu = [m.cpu_seconds for m in trade.moments]
    axes.plot(cpu, quality, "s--", color=ORANGE, ms=3, label="CPU, all threads")
    for below in (0.1, 0.5):
        level = quality[-1] - below
        axes.axhline(level, color=GREY, linewidth=0.8, linestyle=":")
        axes.annotate(
            f"last − {below:g} dB",
            (0, level),
            (4, 1),
            textcoords="offset points",
            fontsize=8,
            color=GREY,
        )
    axes.set_xlim(left=0)
    axes.legend(loc="lower right")
    return figure


def _formats(trade: Trade) -> Figure:
    figure, axes = new_plot("The run in each file format", "file size (MB)", _PSNR)
    for point in trade.formats:
        written = point.label.removeprefix(".") in trade.exported
        _with_bars(axes, [_megabytes(point)], [point], ORANGE if written else BLUE, "o")
    for alike in _alike(trade.formats):
        place = (_megabytes(alike[0]), alike[0].psnr_db)
        names = "\n".join(point.label for point in alike)
        axes.annotate(names, place, (5, -3), textcoords="offset points", fontsize=8, va="top")
    axes.axhline(trade.own.psnr_db, color=GREY, linewidth=0.8, linestyle=":")
    axes.margins(x=0.1)
    _logarithmic(axes)
    _legend(axes, ("other formats", BLUE), ("written by this run", ORANGE))
    return figure


def _megabytes(point: Point) -> float:
    return (point.size_bytes or 0) / 1e6


def _alike(points: Sequence[Point]) -> list[list[Point]]:
    """Points, smallest first, in groups that lie too close to be labelled one by one."""
    groups: list[list[Point]] = []
    for point in points:
        first = groups[-1][0] if groups else None
        near = first is not None and _megabytes(point) < _CLOSE * _megabytes(first)
        if first is not None and near and abs(point.psnr_db - first.psnr_db) < _CLOSE_DB:
            groups[-1].append(point)
        else:
            groups.append([point])
    return groups


def _splats(trade: Trade) -> Figure:
    title = "Fewer splats, least worth first, not fine-tuned"
    figure, axes = new_plot(title, "splats", _PSNR)
    _curve(axes, trade, [float(point.splats) for point in trade.counts])
    axes.xaxis.set_major_formatter("{x:,.0f}")
    return figure


def _drawing(trade: Trade) -> Figure:
    title = f"Fewer splats, pictures of {trade.side_px} pixels, on this machine"
    figure, axes = new_plot(title, "milliseconds a picture", _PSNR)
    _curve(axes, trade, [1000 * (point.frame_s or 0.0) for point in trade.counts])
    return figure


def _curve(axes: Axes, trade: Trade, costs: list[float]) -> None:
    """The counts over what they cost, with the chosen point and the knee marked."""
    points = trade.counts
    axes.plot(costs, [p.psnr_db for p in points], "-", color=BLUE, linewidth=1)
    _with_bars(axes, costs[1:], points[1:], BLUE, "o")
    axes.plot(costs[:1], [points[0].psnr_db], "D", color=ORANGE, label="this run")
    at = knee([float(p.splats) for p in points], [p.psnr_db for p in points])
    if at:  # as in the words: the run itself is none
        knee_at = [costs[at]], [points[at].psnr_db]
        axes.plot(*knee_at, "o", ms=13, mfc="none", color=ORANGE, label="knee")
    axes.errorbar([], [], yerr=[], fmt="o", color=BLUE, label="95 % interval of the change")
    axes.legend()


def _with_bars(
    axes: Axes, xs: Sequence[float], points: Sequence[Point], colour: str, mark: str
) -> None:
    """Points with the interval of their change against the run's own splats, where it has ends."""
    for x, point in zip(xs, points, strict=True):
        low, high = point.change.mean - point.change.low, point.change.high - point.change.mean
        bars = [[low], [high]] if max(low, high) < float("inf") else None
        axes.errorbar(
            [x], [point.psnr_db], yerr=bars, fmt=mark, color=colour, ms=5, elinewidth=1, capsize=3
        )


def _photographs(trade: Trade) -> Figure:
    """By number: a name may be in letters that the plot's font lacks."""
    from matplotlib.ticker import MaxNLocator

    figure, axes = new_plot("Each held-out photograph", "number of the photograph", _PSNR)
    numbers = range(1, len(trade.scores) + 1)
    axes.plot(numbers, [s.psnr_db for s in trade.scores], "o", color=BLUE, label="photograph")
    worst = trade.scores.index(trade.worst)
    axes.plot(
        [worst + 1], [trade.worst.psnr_db], "o", color=ORANGE, label=f"worst: no. {worst + 1}"
    )
    axes.axhline(trade.own.psnr_db, color=GREY, linewidth=0.8, linestyle=":", label="mean")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.legend()
    return figure


def _logarithmic(axes: Axes) -> None:
    from matplotlib.ticker import LogLocator, NullFormatter

    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_formatter(NullFormatter())


def _legend(axes: Axes, *entries: tuple[str, str]) -> None:
    from matplotlib.lines import Line2D

    handles = [Line2D([], [], marker="o", linestyle="", color=c, label=w) for w, c in entries]
    axes.legend(handles=handles, loc="lower right")
