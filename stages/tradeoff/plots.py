"""The plots of a trade-off report: its curves, and a map of the capture."""

from __future__ import annotations

from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from stages.base.plots import BLUE, GREY, ORANGE, new_maps, new_plot, write_plot
from stages.evaluate.coverage import weighted_quantile
from stages.tradeoff.curves import Coverage, Tradeoff

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_PSNR = "held-out PSNR (dB)"
_CELLS = 60  # of the map, along its longer side
_MAX_COUNT, _MAX_ANGLE_DEG = 8.0, 60.0  # more is as good
_MARGIN = 0.08
_SHOWN = (0.03, 0.97)  # quantiles of what is seen, by area: far surfaces would make the rest small
_MIN_CELL_PATCHES = 1.25  # side of a cell over that of a patch: smaller cells leave empty ones
_NAME_DISTANCE = 0.05  # of the map: closer names cannot be read


def write_plots(folder: Path, tradeoff: Tradeoff) -> list[Path]:
    """PNG files, without a plot of time where training logged none. Raises SplatError."""
    figures = {
        "splats": _splats(tradeoff),
        "drawing": _drawing(tradeoff),
    }
    if tradeoff.coverage.layout is not None:
        figures["coverage"] = _coverage_maps(tradeoff.coverage)
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
    title = "Fewer splats, fine-tuned after each removal"
    figure, axes = new_plot(title, "splats", _PSNR)
    _curve(axes, tradeoff, [float(point.splats) for point in tradeoff.pruned])
    axes.xaxis.set_major_formatter("{x:,.0f}")
    return figure


def _drawing(tradeoff: Tradeoff) -> Figure:
    title = f"Fewer splats, pictures of {tradeoff.side_px} pixels, on this machine"
    unit = "CPU time of a picture (ms)" if tradeoff.on_cpu else "GPU time of a picture (ms)"
    figure, axes = new_plot(title, unit, _PSNR)
    _curve(axes, tradeoff, [1000 * (point.draw_seconds or 0.0) for point in tradeoff.pruned])
    return figure


def _curve(axes: Axes, tradeoff: Tradeoff, costs: list[float]) -> None:
    """The pruned splats over their cost, with the run itself and the knee marked."""
    points, at = tradeoff.pruned, tradeoff.knee
    axes.plot(costs, [p.psnr_db for p in points], "-", color=BLUE, linewidth=1)
    for x, point in zip(costs[1:], points[1:], strict=True):
        low, high = point.change.mean - point.change.low, point.change.high - point.change.mean
        bars = [[low], [high]] if point.change.shown else None
        axes.errorbar(
            [x], [point.psnr_db], yerr=bars, fmt="o", color=BLUE, ms=5, elinewidth=1, capsize=3
        )
    axes.plot(costs[:1], [points[0].psnr_db], "D", color=ORANGE, label="this run")
    if at:
        knee_at = [costs[at]], [points[at].psnr_db]
        axes.plot(*knee_at, "o", ms=13, mfc="none", color=ORANGE, label="knee")
    if points[-1].change.shown:
        axes.errorbar([], [], yerr=[], fmt="o", color=BLUE, label="95 % interval of the change")
    axes.legend()


def _coverage_maps(coverage: Coverage) -> Figure:
    """Two maps of the capture seen from above: view counts and angles."""
    figure, (left, right) = new_maps("Seen from above", 2)
    patches = coverage.patches
    _map(figure, left, coverage, patches.counts.astype(float), _MAX_COUNT, "views that see it")
    _map(figure, right, coverage, patches.angles_deg, _MAX_ANGLE_DEG, "angle between views (°)")
    handles, labels = left.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=5, fontsize=8, frameon=False)
    return figure


def _map(
    figure: Figure,
    axes: Axes,
    coverage: Coverage,
    values: NDArray[np.float64],
    most: float,
    label: str,
) -> None:
    patches, layout = coverage.patches, coverage.layout
    assert layout is not None
    to_map = np.stack(layout.map_axes, axis=1)
    at = patches.centres @ to_map
    eyes = np.array([camera.centre for camera in coverage.cameras]) @ to_map
    gaps = [(layout.middle + layout.distance * gap.direction) @ to_map for gap in coverage.gaps]
    gaps = gaps if layout.inward else []
    low, high = _map_corners(at, patches.area, np.array([*eyes, *gaps]))
    longer = float((high - low).max())
    cell = max(longer / _CELLS, _MIN_CELL_PATCHES * patches.side)
    bins = [np.arange(low[i], high[i] + cell, cell) for i in (0, 1)]
    area = np.histogram2d(at[:, 0], at[:, 1], bins, weights=patches.area)[0]
    total = np.histogram2d(at[:, 0], at[:, 1], bins, weights=patches.area * values)[0]
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.where(area > 0, total / area, np.nan)
    drawn = axes.pcolormesh(*bins, mean.T, cmap="RdYlGn", vmin=0, vmax=most)
    bar = figure.colorbar(drawn, ax=axes, extend="max", location="bottom", shrink=0.8, pad=0.02)
    bar.set_label(label, fontsize=9)
    axes.plot(*eyes.T, "^", color="black", ms=4, label="photograph")
    _annotate_names(axes, coverage.names, eyes, _NAME_DISTANCE * longer)
    if len(coverage.floaters):
        floaters = coverage.floaters @ to_map
        axes.plot(*floaters.T, "x", color="red", ms=4, label="floater")
    if layout.inward:
        axes.plot(*(layout.middle @ to_map), "+", color="black", ms=9, label="middle")
        _mark(axes, gaps, "123", GREY, "gap: no photograph from there")
    regions = [region.centre @ to_map for region in coverage.regions]
    _mark(axes, regions, "abc", ORANGE, "poorly covered region")
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])


def _annotate_names(
    axes: Axes, names: tuple[str, ...], eyes: NDArray[np.float64], distance: float
) -> None:
    """The photographs' names, without those that would overlap, or that the plot's font lacks
    letters for."""
    named = np.zeros((0, 2))
    for name, eye in zip(names, eyes, strict=True):
        if name.isascii() and (np.linalg.norm(named - eye, axis=1) > distance).all():
            at, stem = (eye[0], eye[1]), PurePosixPath(name).stem
            axes.annotate(stem, at, (3, 2), textcoords="offset points", fontsize=5)
            named = np.concatenate([named, eye[None]])


def _map_corners(
    at: NDArray[np.float64], area: NDArray[np.float64], marks: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Corners of a map that shows all marks, and most of what is seen."""
    shown = [weighted_quantile(at, area, share) for share in _SHOWN]
    low, high = np.minimum(shown[0], marks.min(axis=0)), np.maximum(shown[1], marks.max(axis=0))
    margin = _MARGIN * max(float((high - low).max()), 1e-9)
    return low - margin, high + margin


def _mark(
    axes: Axes, points: list[NDArray[np.float64]], names: str, colour: str, label: str
) -> None:
    for number, (at, name) in enumerate(zip(points, names, strict=False)):
        axes.plot(*at, "o", ms=11, mfc="white", mec=colour, label="" if number else label)
        axes.annotate(name, (at[0], at[1]), fontsize=8, ha="center", va="center", color="black")
