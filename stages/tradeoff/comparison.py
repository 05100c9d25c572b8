"""Two runs of the same photographs, compared view by view: `report.html` and `compare.csv`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from stages.base.atomic import write_csv
from stages.base.errors import UsageError
from stages.base.text import counted
from stages.evaluate.evaluation import (
    SIZES,
    EvaluationView,
    Score,
    evaluate_at_sizes,
    image_renderer,
    load_evaluation_views,
)
from stages.scene import (
    TRANSPARENT,
    Reconstruction,
    Splats,
    View,
    evenly_spaced,
    split_held_out,
)
from stages.tradeoff import html
from stages.tradeoff.curves import change_of, mean_db
from stages.tradeoff.intervals import (
    OTHER_VIEWS,
    TRAINING_VIEWS,
    Difference,
)


@dataclass(frozen=True)
class Candidate:
    """One of the two runs. facts: further lines of the report, text by name."""

    name: str
    splats: Splats
    reconstruction: Reconstruction
    backend: str
    facts: dict[str, str]

    @property
    def split(self) -> tuple[dict[str, View], dict[str, View]]:
        """The training and the held-out views of this run by name."""
        training, held_out = split_held_out(self.reconstruction.views)
        return {view.name: view for view in training}, {view.name: view for view in held_out}

    def side_px(self, name: str) -> int:
        """Longer side of the held-out view `name`, as this run draws it."""
        camera = self.splats.draw_settings.camera(self.split[1][name].camera)
        return max(camera.width, camera.height)

    @property
    def corrects_light(self) -> bool:
        """Whether this run was trained on photographs brought to their median light."""
        return self.splats.draw_settings.light

    def views(self, names: Sequence[str], side_px: int, light: bool) -> tuple[EvaluationView, ...]:
        """The views `names` with this run's cameras. light: whether their photographs are brought
        to their median light. Raises SplatError."""
        settings = replace(self.splats.draw_settings, side=side_px, light=light)
        by_name = {view.name: view for view in self.reconstruction.views}
        chosen = [by_name[name] for name in names]
        return tuple(load_evaluation_views(self.reconstruction.folder, chosen, settings))


@dataclass(frozen=True)
class Comparison:
    """Two candidates on the same held-out views.

    Args:
        candidates: the first and the second.
        views: of each, in the same order.
        by_size: the scores of each, in that order, at each of `SIZES`.
        psnr, ssim: of the second less the first, at the full size.
        psnr_by_size: the same at each of `SIZES`.
        side_px: longer side of every picture at the full size.
    """

    candidates: tuple[Candidate, Candidate]
    views: tuple[tuple[EvaluationView, ...], tuple[EvaluationView, ...]]
    by_size: tuple[dict[str, list[Score]], dict[str, list[Score]]]
    ssim: Difference
    psnr_by_size: dict[str, Difference]
    side_px: int

    @property
    def psnr(self) -> Difference:
        return self.psnr_by_size["full"]

    @property
    def scores(self) -> tuple[list[Score], list[Score]]:
        """Of each, at the full size."""
        first, second = self.by_size
        return first["full"], second["full"]


def compare_runs(first: Candidate, second: Candidate) -> Comparison:
    """Evaluate both on the views that both hold out, at the smaller size of the two, each with its
    own run's camera, on the pixels that count in both. Views without such a pixel at some size are
    left out. Raises SplatError (compare-nothing-in-common, compare-no-pixels)."""
    training, names = (sorted(a.keys() & b) for a, b in zip(first.split, second.split, strict=True))
    if not names:
        raise UsageError(
            "compare-nothing-in-common",
            given=f"No photograph is held out of both {first.name} and {second.name}.",
            wanted="Photographs that neither run was trained on, to compare them by.",
            hint="Make both runs of the same photographs, four or more, without --no-hold-out.",
        )
    both = (first, second)
    side_px = min(one.side_px(name) for one in both for name in names)
    held_out = _on_common_pixels(both, names, side_px)
    if not held_out:
        raise _no_pixels(first, second)
    seen, count = evenly_spaced(training, TRAINING_VIEWS), len(held_out)
    pairs = [*held_out, *_on_common_pixels(both, seen, side_px)]
    a, b = (
        evaluate_at_sizes(image_renderer(one.splats, one.backend), [pair[i] for pair in pairs])
        for i, one in enumerate(both)
    )
    ssim = change_of(b["full"], a["full"], count, "ssim")
    psnr = {size: change_of(b[size], a[size], count) for size in SIZES}
    a, b = ({size: scores[:count] for size, scores in found.items()} for found in (a, b))
    views = tuple(view for view, _ in held_out), tuple(view for _, view in held_out)
    return Comparison(both, views, (a, b), ssim, psnr, side_px)


def _on_common_pixels(
    both: tuple[Candidate, Candidate], names: Sequence[str], side_px: int
) -> list[tuple[EvaluationView, EvaluationView]]:
    """The views `names` of both, compared where both masks are valid: the run with the smaller ones
    would be better because they leave out what is hard to draw. Photographs are as they were taken
    unless both runs correct their light. Views without a compared pixel at some of `SIZES` are left
    out."""
    light = all(one.corrects_light for one in both)
    views = (one.views(names, side_px, light) for one in both)
    pairs = (_on_pixels_of_both(a, b) for a, b in zip(*views, strict=True))
    return [pair for pair in pairs if all(map(_counts_at_every_size, pair))]


def _on_pixels_of_both(
    first: EvaluationView, second: EvaluationView
) -> tuple[EvaluationView, EvaluationView]:
    """The views of one photograph, compared where both masks are valid. Where the photograph is not
    cut out alike in both, transparent pixels are not compared: each would have another truth."""
    a, b = first, second
    cut_out = TRANSPARENT in (a.outside, b.outside) and not np.array_equal(a.pixels, b.pixels)
    if cut_out:
        a, b = a.compared_where_solid(), b.compared_where_solid()
    a, b = a.compared_within(b.valid), b.compared_within(a.valid)
    return (a.black_where_not_compared(), b.black_where_not_compared()) if cut_out else (a, b)


def _counts_at_every_size(view: EvaluationView) -> bool:
    return view.valid is None or all(view.scaled(scale).counts for scale in SIZES.values())


def _no_pixels(first: Candidate, second: Candidate) -> UsageError:
    return UsageError(
        "compare-no-pixels",
        given=f"The masks of {first.name} and {second.name} leave no pixel of a held-out "
        "photograph that counts in both at full, half and quarter size.",
        wanted="Held-out photographs that masks do not cover whole.",
        hint="Make one of the runs again with larger masks, or without --masks.",
    )


def verdict_lines(comparison: Comparison) -> list[str]:
    """Whether the second candidate is better, and how sure that is."""
    change, (a, b) = comparison.psnr, comparison.candidates
    return [
        f"{b.name} against {a.name}: {_in_words(change, 2, ' dB')}",
        *(
            f"At {size} size: {_in_words(comparison.psnr_by_size[size], 2, ' dB')}"
            for size in ("half", "quarter")
        ),
        f"SSIM: {_in_words(comparison.ssim, 4)}",
        *_about_light(a, b),
        f"Measured on {counted(change.views, 'held-out view')}, {comparison.side_px} pixels large. "
        "Each is one run: the interval does not say whether the same settings would be better with "
        "another seed.",
    ]


def _about_light(first: Candidate, second: Candidate) -> list[str]:
    if first.corrects_light == second.corrects_light:
        return []
    one = first if first.corrects_light else second
    return [
        f"Only {one.name} was trained on photographs brought to one exposure and white balance. "
        "Both are compared with the photographs as they were taken."
    ]


def _in_words(change: Difference, digits: int, unit: str = "") -> str:
    interval = f"{OTHER_VIEWS}: {change.low:+.{digits}f} to {change.high:+.{digits}f}"
    interval = interval if change.shown else "no interval"
    return f"{change.mean:+.{digits}f}{unit} ({interval}): {change.verdict}."


def fact_rows(comparison: Comparison) -> list[tuple[str, str, str]]:
    """(name, of the first, of the second)."""
    first, second = (candidate.facts for candidate in comparison.candidates)
    a, b = comparison.by_size
    means = [
        (f"held-out PSNR, {size} size", f"{mean_db(a[size]):.2f} dB", f"{mean_db(b[size]):.2f} dB")
        for size in SIZES
    ]
    rows = [(name, first.get(name, "-"), second.get(name, "-")) for name in first | second]
    return [*means, *rows]


def distinct_name(folder: Path, other: Path) -> str:
    """A run folder's own name, with its parent's where the other folder has the same."""
    here, there = folder.absolute(), other.absolute()
    return here.name if here.name != there.name else f"{here.parent.name}/{here.name}"


def write_comparison(folder: Path, comparison: Comparison) -> list[Path]:
    """Write the report and the table into `folder`, which exists. Raises SplatError."""
    a, b = (candidate.name for candidate in comparison.candidates)
    pairs = list(zip(*comparison.scores, strict=True))
    table = folder / "compare.csv"
    lines: list[tuple[str, ...]] = [
        ("photograph", "first_psnr_db", "second_psnr_db", "first_ssim", "second_ssim")
    ]
    for one, two in pairs:
        figures = (one.psnr_db, two.psnr_db, one.ssim, two.ssim)
        lines.append((one.name, *(f"{x:.5f}" for x in figures)))
    write_csv(table, lines)
    report = folder / "report.html"
    rows = [
        (
            one.name,
            *(f"{score.psnr_db:.2f} dB" for score in (one, two)),
            f"{two.psnr_db - one.psnr_db:+.2f} dB",
        )
        for one, two in pairs
    ]
    parts = [
        html.paragraphs(verdict_lines(comparison)),
        html.heading("The runs"),
        html.table(("", a, b), fact_rows(comparison)),
        html.heading("Photograph by photograph"),
        html.table(("photograph", f"{a}, PSNR", f"{b}, PSNR", "change"), rows),
        html.heading("Side by side"),
        *_pictures(comparison),
    ]
    html.write_page(report, f"{a} and {b}", parts)
    return [report, table]


def _pictures(comparison: Comparison) -> list[str]:
    draw = [image_renderer(one.splats, one.backend) for one in comparison.candidates]
    rows = []
    for i, seen in enumerate(zip(*comparison.views, strict=True)):
        shown = [(f"{seen[0].name}: the photograph", seen[0].image)]
        for k, candidate in enumerate(comparison.candidates):
            caption = f"{candidate.name}, {comparison.scores[k][i].psnr_db:.2f} dB"
            shown.append((caption, draw[k](seen[k].camera)))
        rows.append(html.pictures(shown))
    return rows
