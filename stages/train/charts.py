"""The contact sheets of held-out views beside their renders (`held_out.png`) and of what moved
(`transients.png`), and the plot of the evaluations during training (`training.png`)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from stages.base.atomic import replacing
from stages.base.plots import BLUE, ORANGE, new_plot, write_plot
from stages.evaluate.evaluation import SIZES
from stages.scene.pictures import scaled_image
from stages.train.history import HistoryEntry
from stages.train.views import Level

SHEET_COLUMN = 480  # pixels, at most
ERROR_GAIN = 4.0


def contact_sheet(
    path: Path,
    rows: Sequence[tuple[str, Sequence[float | None], NDArray[np.float32], NDArray[np.float32]]],
) -> None:
    """A PNG with a numbered row for each (name, PSNR in dB at each of `SIZES` or None, render,
    photograph): photograph, render, absolute error x 4; and a .txt beside it that says which number
    is which photograph, since the picture's font knows only ASCII."""
    strips, legend = [], []
    for number, (name, decibels, image, truth) in enumerate(rows, 1):
        figures = ", ".join(
            f"{size} size {psnr:.2f} dB"
            for size, psnr in zip(SIZES, decibels, strict=True)
            if psnr is not None
        )
        legend.append(f"{number}  {name}  {figures}\n")
        error = np.clip(np.abs(image - truth) * ERROR_GAIN, 0, 1)
        text = f"photograph | render {decibels[0]:.2f} dB | error x{ERROR_GAIN:.0f}"
        strips.append(_strip(path, number, name, text, (truth, image, error)))
    if strips:
        _save_sheet(path, strips, legend)


def transients_sheet(path: Path, views: Sequence[tuple[str, Level]]) -> None:
    """A PNG with a numbered row for each photograph by name: as it was taken, and with grey where
    training ignored it; and a .txt as of `contact_sheet`."""
    strips, legend = [], []
    for number, (name, level) in enumerate(views, 1):
        photograph = level.pixels.transpose(1, 2, 0) * np.float32(1 / 255)
        ignored = np.zeros_like(photograph) if level.mask is None else level.mask[..., None] == 0
        used = np.where(ignored, np.float32(0.5), photograph)
        strips.append(_strip(path, number, name, "photograph | used", (photograph, used)))
        legend.append(f"{number}  {name}\n")
    _save_sheet(path, strips, legend)


def _strip(
    path: Path, number: int, name: str, text: str, tiles: Sequence[NDArray[np.float32]]
) -> NDArray[np.uint8]:
    """Pictures side by side, below a title."""
    strip = np.hstack([_fitted(tile) for tile in tiles])
    title = np.full((26, strip.shape[1], 3), 24, np.uint8)
    shown = f"{number}  {name if name.isascii() else f'(see {path.stem}.txt)'}   {text}"
    cv2.putText(title, shown, (8, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (220,) * 3, 1, cv2.LINE_AA)
    return np.vstack([title, strip])


def _save_sheet(path: Path, strips: Sequence[NDArray[np.uint8]], legend: Sequence[str]) -> None:
    """Write the strips, one below another, as a PNG, and the legend beside it."""
    width = max(strip.shape[1] for strip in strips)
    padded = [np.pad(s, ((0, 0), (0, width - s.shape[1]), (0, 0))) for s in strips]
    with replacing(path) as temporary:
        Image.fromarray(np.vstack(padded)).save(temporary, format="PNG")
    with replacing(path.with_suffix(".txt")) as temporary:
        temporary.write_text("".join(legend), encoding="utf-8")


def training_plot(path: Path, history: Sequence[HistoryEntry]) -> None:
    """A PNG of held-out PSNR (dB) and number of splats over the steps; none without two figures."""
    points = [(h.step, h.psnr_db, h.splats) for h in history if h.psnr_db is not None]
    if len(points) < 2:
        return
    steps, psnr_db, splats = zip(*points, strict=True)
    figure, quality = new_plot("Evaluations during training", "step", "held-out PSNR (dB)")
    counts = quality.twinx()
    counts.set_ylabel("splats")
    lines = [
        *quality.plot(steps, psnr_db, "o-", color=BLUE, ms=4),
        *counts.plot(steps, splats, "s--", color=ORANGE, ms=3),
    ]
    counts.set_ylim(bottom=0)
    counts.yaxis.set_major_formatter("{x:,.0f}")
    quality.legend(lines, ["held-out PSNR", "splats"], loc="lower right")
    write_plot(path, figure)


def _fitted(image: NDArray[np.float32]) -> NDArray[np.uint8]:
    height, width = image.shape[:2]
    scale = min(1.0, SHEET_COLUMN / width)
    small = scaled_image(image, max(1, round(width * scale)), max(1, round(height * scale)))
    return np.asarray(np.round(np.clip(small, 0, 1) * 255), np.uint8)
