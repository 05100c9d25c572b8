"""The plots of a trade-off report."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from stages.base.plots import BLUE, GREY, ORANGE, new_plot, write_plot
from stages.tradeoff.curves import Tradeoff
from stages.tradeoff.intervals import OTHER_VIEWS

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_PSNR = "held-out PSNR (dB)"


def write_plots(folder: Path, tradeoff: Tradeoff) -> list[Path]:
    """PNG files, without a plot of time where training logged none. Raises SplatError."""
    figures = {"splats": _splats(tradeoff)}
    if len(tradeoff.history) > 1:
        figures = {"time": _time(tradeoff), **figures}
    paths = []
    for name, figure in figures.items():
        paths.append(folder / f"{name}.png")
        write_plot(paths[-1], figure)
    return paths


def _time(tradeoff: Tradeoff) -> Figure:
    title = "Quality against training time"
    figure, axes = new_plot(title, "CPU time of all threads (s)", _PSNR)
    quality = [h.psnr_db for h in tradeoff.history]
    times = [h.cpu_seconds for h in tradeoff.history]
    axes.plot(times, quality, "o-", color=BLUE, ms=4, label="training")
    for below in (0.1, 0.5):
        level, text = quality[-1] - below, f"last − {below:g} dB"
        axes.axhline(level, color=GREY, linewidth=0.8, linestyle=":")
        axes.annotate(text, (0, level), (4, 1), textcoords="offset points", fontsize=8, color=GREY)
    axes.set_xlim(left=0)
    axes.legend(loc="lower right")
    return figure


def _splats(tradeoff: Tradeoff) -> Figure:
    """With the run itself and the knee marked."""
    title = "Fewer splats, fine-tuned after each removal"
    figure, axes = new_plot(title, "splats", _PSNR)
    points, at = tradeoff.pruned, tradeoff.knee
    counts = [point.splats for point in points]
    axes.plot(counts, [p.psnr_db for p in points], "-", color=BLUE, linewidth=1)
    for point in points[1:]:
        low, high = point.change.mean - point.change.low, point.change.high - point.change.mean
        bars = [[low], [high]] if point.change.shown else None
        at_point = [point.splats], [point.psnr_db]
        axes.errorbar(*at_point, yerr=bars, fmt="o", color=BLUE, ms=5, elinewidth=1, capsize=3)
    axes.plot(counts[:1], [points[0].psnr_db], "D", color=ORANGE, label="this run")
    if at:
        knee_at = [counts[at]], [points[at].psnr_db]
        axes.plot(*knee_at, "o", ms=13, mfc="none", color=ORANGE, label="knee")
    if points[-1].change.shown:
        axes.errorbar([], [], yerr=[], fmt="o", color=BLUE, label=OTHER_VIEWS)
    axes.legend()
    axes.xaxis.set_major_formatter("{x:,.0f}")
    return figure
