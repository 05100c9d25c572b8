"""The capture seen from above: what photographs show how well, and where they were taken."""

from __future__ import annotations

from pathlib import PurePosixPath
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from stages.measure.plots import GREY, ORANGE, new_maps
from stages.measure.tradeoff.thin import Thin

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_CELLS = 60  # of the map, along its longer side
_MOST_COUNT, _MOST_ANGLE_DEG = 8.0, 60.0  # more is as good
_MARGIN = 0.08
_MIDDLE = (0.03, 0.97)  # of what is seen, by area: what is far away would make the rest small
_PATCHES = 1.25  # to a cell, a side, at least: fewer leave gaps between them
_APART = 0.05  # of the map: names that stand closer cannot be read


def plan_view(thin: Thin) -> Figure:
    """Two maps side by side, of counts and of angles. thin: with a ring."""
    figure, (left, right) = new_maps("Seen from above", 2)
    counts = thin.patches.counts.astype(float)
    _map(figure, left, thin, counts, _MOST_COUNT, "photographs that see it")
    _map(figure, right, thin, thin.patches.angles_deg, _MOST_ANGLE_DEG, "over how many degrees")
    handles, labels = left.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=5, fontsize=8, frameon=False)
    return figure


def _on_map(thin: Thin, places: NDArray[np.float64]) -> NDArray[np.float64]:
    """[..., 2] right and up on the map, of places [..., 3]."""
    assert thin.ring is not None
    found: NDArray[np.float64] = places @ np.stack(thin.ring.plan, axis=1)
    return found


def _map(
    figure: Figure, axes: Axes, thin: Thin, values: NDArray[np.float64], most: float, label: str
) -> None:
    patches, ring = thin.patches, thin.ring
    assert ring is not None
    at, eyes = _on_map(thin, patches.centres), _on_map(thin, _eyes(thin))
    sides = [_on_map(thin, ring.middle + ring.reach * gap.direction) for gap in thin.gaps]
    sides = sides if ring.inward else []
    low, high = _box(at, patches.area, np.array([*eyes, *sides]))
    cell = max(float((high - low).max()) / _CELLS, _PATCHES * patches.side)
    bins = [np.arange(low[i], high[i] + cell, cell) for i in (0, 1)]
    area = np.histogram2d(at[:, 0], at[:, 1], bins, weights=patches.area)[0]
    total = np.histogram2d(at[:, 0], at[:, 1], bins, weights=patches.area * values)[0]
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.where(area > 0, total / area, np.nan)
    drawn = axes.pcolormesh(*bins, mean.T, cmap="RdYlGn", vmin=0, vmax=most)
    bar = figure.colorbar(drawn, ax=axes, extend="max", location="bottom", shrink=0.8, pad=0.02)
    bar.set_label(label, fontsize=9)
    axes.plot(*eyes.T, "^", color="black", ms=4, label="photograph")
    _name(axes, thin.names, eyes, _APART * float((high - low).max()))
    if len(thin.floaters):
        axes.plot(*_on_map(thin, thin.floaters).T, "x", color="red", ms=4, label="floater")
    if ring.inward:
        middle = _on_map(thin, ring.middle)
        axes.plot(*middle, "+", color="black", ms=9, label="middle")
        _mark(axes, sides, "123", GREY, "gap: nothing sees it from there")
    _mark(axes, [_on_map(thin, p.centre) for p in thin.places], "abc", ORANGE, "thin place")
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])


def _name(axes: Axes, names: tuple[str, ...], eyes: NDArray[np.float64], apart: float) -> None:
    """The photographs' names, as far as they do not lie on each other, in letters that the plot's
    font has."""
    named = np.zeros((0, 2))
    for name, eye in zip(names, eyes, strict=True):
        if name.isascii() and (np.linalg.norm(named - eye, axis=1) > apart).all():
            place = (eye[0], eye[1])
            stem = PurePosixPath(name).stem
            axes.annotate(stem, place, (3, 2), textcoords="offset points", fontsize=5)
            named = np.concatenate([named, eye[None]])


def _eyes(thin: Thin) -> NDArray[np.float64]:
    return np.array([camera.centre for camera in thin.cameras])


def _box(
    at: NDArray[np.float64], area: NDArray[np.float64], marks: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Corners of what the map shows: all that is marked, and most of what is seen."""
    ends = []
    for column in at.T:
        order = np.argsort(column)
        running = np.cumsum(area[order])
        rows = np.searchsorted(running, np.array(_MIDDLE) * running[-1])
        ends.append(column[order[rows]])
    low = np.minimum(np.array(ends)[:, 0], marks.min(axis=0))
    high = np.maximum(np.array(ends)[:, 1], marks.max(axis=0))
    margin = _MARGIN * max(float((high - low).max()), 1e-9)
    return low - margin, high + margin


def _mark(
    axes: Axes, places: list[NDArray[np.float64]], names: str, colour: str, label: str
) -> None:
    for number, (place, name) in enumerate(zip(places, names, strict=False)):
        axes.plot(*place, "o", ms=11, mfc="white", mec=colour, label="" if number else label)
        axes.annotate(
            name, (place[0], place[1]), fontsize=8, ha="center", va="center", color="black"
        )
