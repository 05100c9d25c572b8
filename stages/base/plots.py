"""How plots look: axes with units, ticks, a legend, one size."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from stages.base.atomic import replacing

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BLUE, ORANGE, GREY = "#1f5fa8", "#c8641e", "#777777"
_SIZE_INCHES, _DPI = (7.2, 4.0), 110


def new_plot(title: str, x: str, y: str) -> tuple[Figure, Axes]:
    """An empty plot; x, y: what the axes show, with its unit."""
    # Not pyplot: it keeps every figure, and looks for a screen.
    from matplotlib.figure import Figure

    figure = Figure(figsize=_SIZE_INCHES, dpi=_DPI, layout="constrained")
    axes = figure.subplots()
    axes.set_title(title, fontsize=11)
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.grid(color="#dddddd", linewidth=0.6)
    axes.set_axisbelow(True)
    return figure, axes


def write_plot(path: Path, figure: Figure) -> None:
    """A PNG, the same bytes for the same plot. Raises SplatError."""
    with replacing(path) as temporary:
        figure.savefig(temporary, format="png", metadata={"Software": None})
