"""`report.html` and `compare.csv` of two runs."""

from __future__ import annotations

import csv
import io
from pathlib import Path

from stages.base.atomic import replacing
from stages.measure.evaluation import Score, image_renderer
from stages.measure.tradeoff import html
from stages.measure.tradeoff.comparison import Pairing, verdict_lines


def write_pair(folder: Path, pairing: Pairing) -> list[Path]:
    """Both into `folder`, which is there. Raises SplatError."""
    a, b = (side.name for side in pairing.sides)
    table = folder / "compare.csv"
    with replacing(table) as temporary:
        temporary.write_text(_table(pairing), encoding="utf-8")
    report = folder / "report.html"
    parts = [
        html.paragraphs(verdict_lines(pairing)),
        html.heading("The runs"),
        html.table(("", a, b), facts(pairing)),
        html.heading("Photograph by photograph"),
        html.table(
            ("photograph", f"{a}, PSNR", f"{b}, PSNR", "change"),
            [
                (one.name, f"{one.psnr_db:.2f} dB", f"{two.psnr_db:.2f} dB", _change(one, two))
                for one, two in zip(*pairing.scores, strict=True)
            ],
        ),
        html.heading("Side by side"),
        *_pictures(pairing),
    ]
    html.write_page(report, f"{a} and {b}", parts)
    return [report, table]


def facts(pairing: Pairing) -> list[tuple[str, str, str]]:
    """(what, of the first, of the second)."""
    first, second = (side.facts for side in pairing.sides)
    means = [sum(s.psnr_db for s in found) / len(found) for found in pairing.scores]
    rows = [(name, first.get(name, "-"), second.get(name, "-")) for name in first | second]
    return [("held-out PSNR", f"{means[0]:.2f} dB", f"{means[1]:.2f} dB"), *rows]


def _change(one: Score, two: Score) -> str:
    return f"{two.psnr_db - one.psnr_db:+.2f} dB"


def _table(pairing: Pairing) -> str:
    held = io.StringIO()
    writer = csv.writer(held, lineterminator="\n")
    writer.writerow(("photograph", "first_psnr_db", "second_psnr_db", "first_ssim", "second_ssim"))
    for one, two in zip(*pairing.scores, strict=True):
        figures = (one.psnr_db, two.psnr_db, one.ssim, two.ssim)
        writer.writerow((one.name, *(f"{x:.5f}" for x in figures)))
    return held.getvalue()


def _pictures(pairing: Pairing) -> list[str]:
    draw = [image_renderer(side.splats, side.backend) for side in pairing.sides]
    rows = []
    for i, (seen_a, seen_b) in enumerate(zip(*pairing.photographs, strict=True)):
        shown = [(f"{seen_a.name}: the photograph", seen_a.image)]
        for side, drawn, seen, found in zip(
            pairing.sides, draw, (seen_a, seen_b), pairing.scores, strict=True
        ):
            shown.append((f"{side.name}, {found[i].psnr_db:.2f} dB", drawn(seen.camera)))
        rows.append(html.pictures(shown))
    return rows
