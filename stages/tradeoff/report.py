"""`report.html`, `tradeoff.csv` and the plots of one run."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from stages.base.atomic import write_csv
from stages.evaluate.evaluation import image_renderer
from stages.evaluate.image_metrics import psnr_text
from stages.tradeoff import html, report_text
from stages.tradeoff.curves import OperatingPoint, Tradeoff
from stages.tradeoff.intervals import OTHER_VIEWS
from stages.tradeoff.measurement import TradeoffInputs
from stages.tradeoff.plots import write_plots

ERROR_GAIN = 4.0  # of the picture of errors, so that small ones can be seen
_COLUMNS = (
    *("curve", "label", "splats", "bytes", "wall_seconds", "cpu_seconds"),
    *("psnr_db", "change_db", "change_low_db", "change_high_db"),
)
_SECTIONS = {
    "time": ("Time", report_text.about_time),
    "formats": ("Bytes", report_text.about_formats),
    "splats": ("Splats", report_text.about_splats),
    "coverage": ("Coverage", report_text.about_coverage),
    "photographs": ("Photographs", report_text.about_photographs),
}


def summarise(tradeoff: Tradeoff) -> dict[str, list[str]]:
    """The text of the report: title of each section, and its lines."""
    return {title: about(tradeoff) for title, about in _SECTIONS.values()}


def write_report(folder: Path, name: str, tradeoff: Tradeoff, inputs: TradeoffInputs) -> list[Path]:
    """Write everything into `folder`, which exists, and return the files. name: the run's. Raises
    SplatError."""
    plots = {path.stem: path for path in write_plots(folder, tradeoff)}
    table = folder / "tradeoff.csv"
    write_csv(table, (_COLUMNS, *_rows(tradeoff)))
    introduction = (
        f"Quality is the PSNR of {len(tradeoff.scores)} held-out views, which training never saw, "
        f'drawn {tradeoff.side_px} pixels large. What stands after "{OTHER_VIEWS}" holds the mean '
        "change over a dozen other views of this scene in nine of ten cases. It is not about "
        "another run with another seed."
    )
    parts = [html.paragraphs([introduction])]
    for stem, (title, about) in _SECTIONS.items():
        parts += [html.heading(title), html.paragraphs(about(tradeoff))]
        if stem in plots:
            parts.append(html.png(plots[stem], f"Plot: {title}"))
        if stem == "formats":
            parts.append(_formats_table(tradeoff))
    parts += [_photographs_table(tradeoff), _worst(tradeoff, inputs)]
    report = folder / "report.html"
    html.write_page(report, f"Trade-off report: {name}", parts)
    return [report, table, *plots.values()]


def _rows(tradeoff: Tradeoff) -> Iterator[tuple[str, ...]]:
    for h in tradeoff.history:
        times = f"{h.seconds:.2f}", f"{h.cpu_seconds:.2f}"
        row = (str(h.splats), "", *times, f"{h.psnr_db:.4f}")
        yield ("time", f"step {h.step}", *row, "", "", "")
    for curve, points in (("format", tradeoff.formats), ("splats", tradeoff.pruned)):
        for point in points:
            yield (curve, *_row(point))
    for score in tradeoff.scores:
        yield ("photograph", score.name, *[""] * 4, f"{score.psnr_db:.4f}", "", "", "")


def _row(point: OperatingPoint) -> Iterator[str]:
    yield from (point.label, str(point.splats))
    yield "" if point.size_bytes is None else str(point.size_bytes)
    yield from ("", "")
    change = point.change
    yield from (f"{x:.4f}" for x in (point.psnr_db, change.mean, change.low, change.high))


def _formats_table(tradeoff: Tradeoff) -> str:
    rows = [
        (
            point.label + (" (this run)" if point.label[1:] in tradeoff.exported else ""),
            f"{(point.size_bytes or 0) / 1e6:.2f} MB",
            f"{point.psnr_db:.2f} dB",
            f"{point.change.mean:+.3f} dB",
        )
        for point in tradeoff.formats
    ]
    return html.table(("format", "size", "held-out PSNR", "change"), rows)


def _photographs_table(tradeoff: Tradeoff) -> str:
    rows = [
        (f"{number}  {score.name}", psnr_text(score.psnr_db), f"{score.ssim:.3f}")
        for number, score in enumerate(tradeoff.scores, 1)
    ]
    return html.table(("photograph", "PSNR", "SSIM"), rows)


def _worst(tradeoff: Tradeoff, inputs: TradeoffInputs) -> str:
    """The worst photograph, the drawing of it, and the error."""
    view = next(view for view in inputs.held_out if view.name == tradeoff.worst.name)
    drawn = image_renderer(inputs.splats, inputs.backend)(view.camera)
    drawn, truth = np.clip(drawn, 0.0, 1.0), view.image
    error = np.clip(np.abs(drawn - truth) * ERROR_GAIN, 0.0, 1.0)
    return html.pictures(
        (
            (f"{view.name}: the photograph", truth),
            (f"drawn, {tradeoff.worst.psnr_db:.2f} dB", drawn),
            (f"error x {ERROR_GAIN:g}", error),
        )
    )
