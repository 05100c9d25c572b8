"""The final evaluation of a run: metrics, a table, a plot and a contact sheet."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np

from stages.base.atomic import write_csv
from stages.base.stage import Report
from stages.evaluate.evaluation import (
    LARGEST_SUBSET,
    EvaluationView,
    ImageRenderer,
    Score,
    evaluate_at_sizes,
    evaluation_subset,
    load_evaluation_views,
    psnr_as_taken_db,
    psnr_name,
)
from stages.evaluate.verdict import Verdict, fits, verdict
from stages.scene import (
    DrawSettings,
    Reconstruction,
    Splats,
    evenly_spaced,
    split_held_out,
    why_none_is_held_out,
)
from stages.train.charts import contact_sheet, training_plot
from stages.train.history import History

WARNED_FALL_DB = 2.0  # of the held-out PSNR in training


def write_quality(
    render: ImageRenderer,
    views: Sequence[EvaluationView],
    draw_settings: DrawSettings,
    reconstruction: Reconstruction,
    folder: Path,
    report: Report,
) -> None:
    """Evaluate the held-out `views`: metrics go into the report, the contact sheet `held_out.png`
    with its legend into the folder.

    Args:
        render: draws the trained splats.
        draw_settings: they are drawn with.
        reconstruction: the held-out views come from.
    """
    by_size = evaluate_at_sizes(render, views, with_flip=True)
    scores = by_size["full"]
    measured = [i for i, score in enumerate(scores) if score.counts]
    if measured:
        _report_scores(by_size, report)
    elif scores or not any(view.role for view in reconstruction.views):  # else the user wants none
        few = "Too few photographs to hold one out"
        cause = "Masks leave nothing of the held-out photographs" if scores else few
        report.warn("train-nothing-held-out", f"{cause}: quality was not measured.")
    if draw_settings.light and measured:
        _, held = split_held_out(reconstruction.views)
        unadapted, adapted = psnr_as_taken_db(render, reconstruction.folder, held, draw_settings)
        report.metric("psnr_as_taken_db", round(unadapted, 3))
        report.metric("psnr_adapted_db", round(adapted, 3))
    if inside := [score.inside_db for score in scores if score.inside_db is not None]:
        report.metric("psnr_inside_db", round(float(np.mean(inside)), 3))
    figures = [
        {
            psnr_name(name): score.psnr_db if score.counts else None
            for name, score in zip(by_size, same, strict=True)
        }
        for same in zip(*by_size.values(), strict=True)
    ]
    held_out = [asdict(score) | more for score, more in zip(scores, figures, strict=True)]
    report.metric("held_out", [one for one in held_out if one["psnr_db"] is not None])
    sides = (max(view.pixels.shape[:2]) for view in views)
    report.metric("evaluated_side_px", max(sides, default=0))
    rows = []
    worst = sorted(measured, key=lambda i: scores[i].psnr_db)[:1]
    for i in sorted({*(measured[k] for k in evaluation_subset(len(measured))), *worst}):
        image = np.clip(render(views[i].camera), 0.0, 1.0)
        rows.append((views[i].name, list(figures[i].values()), image, views[i].image))
    contact_sheet(folder / "held_out.png", rows)


def report_verdict(
    splats: Splats,
    views: Sequence[EvaluationView],
    reconstruction: Reconstruction,
    backend: str,
    report: Report,
) -> Verdict:
    """The verdict on `splats`, which becomes the metric "verdict". views: all that are held out."""
    training = evenly_spaced(split_held_out(reconstruction.views)[0], LARGEST_SUBSET)
    seen = load_evaluation_views(
        reconstruction.folder, training, splats.draw_settings, report.stop_requested
    )
    why_none = why_none_is_held_out(reconstruction.views)
    found = verdict(fits(splats, views, backend), fits(splats, seen, backend), why_none)
    report.metric("verdict", asdict(found))
    return found


def write_history(history: History, folder: Path, report: Report) -> None:
    """The evaluations during the run as `history.csv` and as a plot. The times, which differ
    between equal runs, go only into the report."""
    rows: list[tuple[object, ...]] = [("step", "splats", "psnr_db", "ssim")]
    for entry in history.entries:
        psnr_db, ssim = entry.psnr_db or float("nan"), entry.ssim or float("nan")
        rows.append((entry.step, entry.splats, f"{psnr_db:.4f}", f"{ssim:.5f}"))
    write_csv(folder / "history.csv", rows)
    training_plot(folder / "training.png", history.entries)
    fall_db, step = history.largest_fall_db
    report.metric("largest_fall_db", round(fall_db, 3))
    if fall_db > WARNED_FALL_DB:
        report.warn(
            "train-quality-fell",
            f"The PSNR of held-out photographs fell by {fall_db:.1f} dB until step {step:,}, below "
            "what it was before. See training.png.",
        )
    both = zip(history.entries, history.times, strict=True)
    report.metric("history", [entry.figures | asdict(elapsed) for entry, elapsed in both])


def _report_scores(by_size: Mapping[str, Sequence[Score]], report: Report) -> None:
    scores = [score for score in by_size["full"] if score.counts]
    worst = min(scores, key=lambda score: score.psnr_db)
    flips = [score.flip for score in scores if score.flip is not None]
    for name, same in by_size.items():
        if found := [score.psnr_db for score in same if score.counts]:
            report.metric(psnr_name(name), round(float(np.mean(found)), 3))
    report.metric("psnr_worst_db", round(worst.psnr_db, 3))
    report.metric("psnr_worst_view", worst.name)
    report.metric("ssim", round(float(np.mean([score.ssim for score in scores])), 4))
    if flips:
        report.metric("flip", round(float(np.mean(flips)), 4))
