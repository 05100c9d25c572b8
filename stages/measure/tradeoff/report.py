"""`report.html`, `tradeoff.csv` and the plots of one run."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from stages.base.atomic import replacing
from stages.measure.evaluation import image_renderer
from stages.measure.tradeoff import html, summary, thin_words
from stages.measure.tradeoff.curves import Point, Trade
from stages.measure.tradeoff.measurement import TradeoffInputs
from stages.measure.tradeoff.plots import write_plots

_COLUMNS = (
    *("curve", "label", "splats", "bytes", "wall_seconds", "cpu_seconds", "frame_seconds"),
    *("psnr_db", "change_db", "change_low_db", "change_high_db"),
)
_SECTIONS = {
    "time": ("Time", summary.about_time),
    "formats": ("Bytes", summary.about_formats),
    "splats": ("Splats", summary.about_splats),
    "drawing": ("Drawing", summary.about_drawing),
    "coverage": ("Coverage", thin_words.about_coverage),
    "framing": ("Framing", thin_words.about_framing),
    "photographs": ("Photographs", summary.about_photographs),
}


def summarise(trade: Trade) -> dict[str, list[str]]:
    """What the report says, by section."""
    return {title: say(trade) for title, say in _SECTIONS.values()}


def write_report(folder: Path, name: str, trade: Trade, material: TradeoffInputs) -> list[Path]:
    """Everything into `folder`, which is there; name: the run's. The files. Raises SplatError."""
    plots = {path.stem: path for path in write_plots(folder, trade)}
    table = folder / "tradeoff.csv"
    with replacing(table) as temporary:
        temporary.write_text(_table(trade), encoding="utf-8")
    parts = [
        html.paragraphs(
            [
                f"Quality is PSNR of {len(trade.scores)} photographs that training never saw, "
                f"drawn {trade.side_px} pixels large. Intervals (95 %) are of the difference to "
                "this run's splats, photograph by photograph: they speak of other photographs of "
                "this scene, not of another run's luck."
            ]
        )
    ]
    for stem, (title, say) in _SECTIONS.items():
        parts += [html.heading(title), html.paragraphs(say(trade))]
        if stem in plots:
            parts.append(html.png(plots[stem], f"Plot: {title}"))
        if stem == "formats":
            parts.append(_formats_table(trade))
        if stem == "framing":
            parts.append(_framings(trade))
    parts += [_photographs_table(trade), _worst(trade, material)]
    report = folder / "report.html"
    html.write_page(report, f"The trade of {name}", parts)
    return [report, table, *plots.values()]


def _table(trade: Trade) -> str:
    held = io.StringIO()
    writer = csv.writer(held, lineterminator="\n")
    writer.writerow(_COLUMNS)
    for m in trade.moments:
        row = (m.splats, "", f"{m.seconds:.2f}", f"{m.cpu_seconds:.2f}", "", f"{m.psnr_db:.4f}")
        writer.writerow(("time", f"step {m.step}", *row, "", "", ""))
    for curve, points in (("format", trade.formats), ("splats", trade.counts)):
        writer.writerows(_row(curve, point) for point in points)
    for score in trade.scores:
        figure = f"{score.psnr_db:.4f}"
        writer.writerow(("photograph", score.name, *[""] * 5, figure, "", "", ""))
    return held.getvalue()


def _row(curve: str, point: Point) -> Iterator[str]:
    yield from (curve, point.label, str(point.splats))
    yield "" if point.size_bytes is None else str(point.size_bytes)
    yield from ("", "", "" if point.frame_s is None else f"{point.frame_s:.5f}")
    change = point.change
    yield from (f"{x:.4f}" for x in (point.psnr_db, change.mean, change.low, change.high))


def _formats_table(trade: Trade) -> str:
    rows = [
        (
            point.label,
            f"{(point.size_bytes or 0) / 1e6:.2f} MB",
            f"{point.psnr_db:.2f} dB",
            f"{point.change.mean:+.3f} dB",
        )
        for point in trade.formats
    ]
    return html.table(("format", "size", "held-out PSNR", "change"), rows)


def _photographs_table(trade: Trade) -> str:
    rows = [
        (f"{number}  {score.name}", f"{score.psnr_db:.2f} dB", f"{score.ssim:.3f}")
        for number, score in enumerate(trade.scores, 1)
    ]
    return html.table(("photograph", "PSNR", "SSIM"), rows)


def _framings(trade: Trade) -> str:
    """The scene from elsewhere, three pictures a row."""
    shown = [
        (f"{framing.label}: shimmer {framing.shimmer:.1f} of 255", framing.image)
        for framing in trade.thin.framings
    ]
    return "".join(html.pictures(shown[i : i + 3]) for i in range(0, len(shown), 3))


def _worst(trade: Trade, material: TradeoffInputs) -> str:
    """The worst photograph, what is drawn of it, and what lies between."""
    photograph = next(p for p in material.held_out if p.name == trade.worst.name)
    drawn = image_renderer(material.splats, material.backend)(photograph.camera)
    drawn, truth = np.clip(drawn, 0.0, 1.0), photograph.image
    return html.pictures(
        (
            (f"{photograph.name}: the photograph", truth),
            (f"drawn, {trade.worst.psnr_db:.2f} dB", drawn),
            (f"error x {html.ERROR_GAIN:g}", html.error_of(drawn, truth)),
        )
    )
