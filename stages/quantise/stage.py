"""Stage 6: chooses at which precision splats are stored, and fine-tunes them to the rounding of the
requested file formats.

View-dependent colour takes up to three quarters of a file. The SH degree is lowered, for all splats
and then for each, as far as training views do not show it. Held-out views measure the result and
decide nothing. What the 8-bit .splat costs is measured, too.

Splats that were trained with opacity compensation are fine-tuned for the formats that are drawn
without it.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.base.atomic import replacing
from stages.base.bad_files import reading, stage_output
from stages.base.errors import RunFolderError
from stages.base.stage import Report
from stages.evaluate.evaluation import (
    SIZES,
    EvaluationView,
    evaluation_subset,
    load_evaluation_views,
    mean_psnr_db,
    psnr_name,
)
from stages.evaluate.sh import sufficient_degrees, truncate_sh, view_averaged_dc
from stages.formats.format_table import FORMATS, PLAIN
from stages.formats.sog_bits import choose_bits
from stages.formats.sog_quantisation import splats_to_write
from stages.prune.settings import DECIDING_VIEWS
from stages.quantise.format_finetuning import FormatFinetuning
from stages.quantise.rounding import write_and_read
from stages.quantise.settings import QuantiseSettings
from stages.raster.backends import report_backend
from stages.scene import (
    DrawSettings,
    PrunedSplats,
    QuantisedSplats,
    Reconstruction,
    SizeLimit,
    Splats,
    TrainedSplats,
    evenly_spaced,
    load_splats,
    save_splats,
    split_held_out,
)

_DECISIONS, _FLAT, _FINETUNED = "decisions.json", "flat_dc.npy", "finetuned"
_SOG = "sog"  # the format whose bits are chosen
_PLAIN_CHANGE = "plain_drawing_change_db"
_PLAIN_LOSS_DB = 1.0  # at which the report warns
# Change of colour (of 255) that a splat's higher SH degrees may make and still be dropped, largest
# first.
_THRESHOLDS_OF_255 = (8.0, 4.0, 2.0, 1.0, 0.5, 0.25)
_BIT_DEPTH_MEASUREMENTS = 25  # about, for the progress bar


def run(
    inputs: Mapping[str, Any], settings: QuantiseSettings, folder: Path, report: Report
) -> QuantisedSplats:
    """Decide on the splats of inputs["prune"] by training views of inputs["sfm"].

    Metrics: psnr_raw_db, psnr_kept_db, psnr_plain_db, psnr_splat32_db (means over the held-out
    views, or over the deciding views where none are held out), plain_drawing_change_db, sh_degree,
    splats_by_sh_degree, bits (if a .sog is requested), raw_mib, kept_mib; formats: by format that
    was fine-tuned to, rounded_db and finetuned_db (see `quantise.format_finetuning`). Raises
    SplatError if a photograph cannot be read, and Interrupted.
    """
    pruned: PrunedSplats = inputs["prune"]
    splats = pruned.splats
    trained: TrainedSplats = inputs["train"]
    reconstruction = inputs["sfm"].with_cameras(trained.cameras).with_masks(trained.masks)
    decider, evaluator = _measures(reconstruction, splats.draw_settings, settings, report)
    earlier = _Earlier.of(report)
    kept, by_degree, threshold = (
        earlier.sh if earlier else _choose_sh_degrees(splats, settings, decider)
    )
    finetuning = FormatFinetuning.of(kept, reconstruction, trained, settings, decider.views, report)
    plain = finetuning.to_plain_drawing(kept, earlier.quantised.plain if earlier else None)
    if earlier and (earlier.quantised.plain is None) != (plain is None):
        earlier = None  # all that follows depends on it
    flat = earlier.quantised.flat_dc if earlier else None
    if not earlier:
        flat = _flat_colours(kept if plain is None else plain, reconstruction, settings)
    quantised = QuantisedSplats(
        kept, None, flat, plain=plain, drawing=settings.drawing, limit=pruned.limit
    )
    bits, sog_db = _sog_bits(quantised, settings, decider, earlier)
    figures = earlier.figures if earlier else _figures(splats, quantised, evaluator)
    figures = {**figures, "bits": bits, "measured_on": evaluator.what}
    decisions: dict[str, object] = {
        **figures,
        "psnr_sog_training_db": sog_db,
        "sh_loss_db": settings.sh_loss_db,
        "drawing": settings.drawing,
        "colour_loss_of_255": threshold,
        "views": len(decider.views),
        "psnr_by_sh_degree_db": {str(d): by_degree[d] for d in sorted(by_degree)},
    }
    _report(figures, {"raw_mib": splats, "kept_mib": kept}, report)
    report_backend(report, settings.backend)
    quantised = replace(quantised, sog_bits=bits)
    known = (earlier.quantised.finetuned, earlier.finetuning) if earlier else ({}, {})
    quantised = replace(quantised, finetuned=finetuning.to_rounding(quantised, *known))
    _save(folder, quantised, decisions)
    return quantised


def _report(figures: Mapping[str, Any], sizes: Mapping[str, Splats], report: Report) -> None:
    """The figures, and the memory of splats by the name of its metric."""
    for name, value in figures.items():
        report.metric(name, value)
    for name, splats in sizes.items():
        report.metric(name, round(_bytes(splats) / 2**20, 3))
        report.metric("evaluated_side_px", splats.draw_settings.side)
    lost_db = -figures.get(_PLAIN_CHANGE, 0.0)
    if lost_db > _PLAIN_LOSS_DB:
        report.warn(
            "quantise-plain-drawing",
            f"Drawn plainly, as most programs draw .ply, .sog, .glb and .usdz, the splats have "
            f"{lost_db:.1f} dB less than antialiased, as they were trained. `--drawing plain` with "
            "`splat process` trains them for it; more --plain-steps regain a part.",
        )


@dataclass(frozen=True)
class _Earlier:
    """What was decided when other formats were requested, and holds for these as well.

    Attributes:
        quantised: as then.
        sh: what `_choose_sh_degrees` returns.
        sog: what `_sog_bits` returned.
        figures: what `_figures` returned.
        finetuning: the figures of fine-tuning by format.
    """

    quantised: QuantisedSplats
    sh: tuple[Splats, dict[int, float], float]
    sog: tuple[dict[str, int] | None, float | None]
    figures: dict[str, object]
    finetuning: Mapping[str, dict[str, float]]

    @classmethod
    def of(cls, report: Report) -> _Earlier | None:
        earlier = report.earlier
        if earlier is None or earlier.same_inputs < {"sfm", "train", "prune"}:
            return None
        quantised = load(earlier.folder)
        found = json.loads((earlier.folder / _DECISIONS).read_text(encoding="utf-8"))
        sog = found["bits"], found.pop("psnr_sog_training_db")
        by_degree = {int(degree): db for degree, db in found.pop("psnr_by_sh_degree_db").items()}
        sh = quantised.splats, by_degree, found.pop("colour_loss_of_255")
        for name in ("sh_loss_db", "drawing", "views", "bits", "measured_on"):
            del found[name]
        found.pop("limit", None)
        return cls(quantised, sh, sog, found, earlier.metrics.get("formats", {}))


def _sog_bits(
    quantised: QuantisedSplats,
    settings: QuantiseSettings,
    decider: _Measure,
    earlier: _Earlier | None,
) -> tuple[dict[str, int] | None, float | None]:
    """What `choose_bits` returns; (None, None) if no .sog is requested."""
    if _SOG not in settings.formats:
        return None, None
    if earlier and earlier.quantised.sog_bits is not None:
        return earlier.sog
    sog = splats_to_write(FORMATS[_SOG], quantised)
    return choose_bits(sog, decider.psnr, settings.sog_loss_db)


def _figures(splats: Splats, quantised: QuantisedSplats, evaluator: _Measure) -> dict[str, object]:
    """The figures of the decision, for the report and for people. splats: before it."""
    kept, plain, row = quantised.splats, quantised.plain, FORMATS["splat"]
    raw_db, kept_db = evaluator.psnr(splats), evaluator.psnr_at_sizes(kept, "psnr_kept")
    plain_db = None if plain is None else evaluator.psnr(plain)
    change = {}
    if plain_db is not None:
        change[_PLAIN_CHANGE] = round(plain_db - kept_db["psnr_kept_db"], 3)
    return {
        "psnr_raw_db": raw_db,
        **kept_db,
        "psnr_plain_db": plain_db,
        **change,
        "psnr_splat32_db": evaluator.psnr(write_and_read(row, splats_to_write(row, quantised))),
        "sh_degree": kept.sh_degree,
        "splats_by_sh_degree": [
            int((kept.sh_degrees == d).sum()) for d in range(kept.sh_degree + 1)
        ],
    }


def _choose_sh_degrees(
    splats: Splats, settings: QuantiseSettings, decider: _Measure
) -> tuple[Splats, dict[int, float], float]:
    """(splats without the SH coefficients that training views do not show; PSNR by the SH degree
    of all; the threshold at which single splats have lost degrees, of 255)."""
    raw_db = decider.psnr(splats)
    by_degree, kept = {splats.sh_degree: raw_db}, splats
    for lower in range(splats.sh_degree):
        candidate = splats.with_sh_degree(lower)
        by_degree[lower] = decider.psnr(candidate)
        if raw_db - by_degree[lower] < settings.sh_loss_db:
            kept = candidate
            break
    for threshold in _THRESHOLDS_OF_255 if kept.sh_degree else ():
        degrees = sufficient_degrees(kept, threshold / 255)
        if np.array_equal(degrees, kept.sh_degrees):
            continue
        candidate = truncate_sh(kept, degrees)
        if raw_db - decider.psnr(candidate) < settings.sh_loss_db:
            return candidate, by_degree, threshold
    return kept, by_degree, 0.0


def _flat_colours(
    splats: Splats, reconstruction: Reconstruction, settings: QuantiseSettings
) -> NDArray[np.float32] | None:
    """[N, 3] DC coefficients for formats without view dependence; None where `splats` have none."""
    if not splats.sh_degree:
        return None
    views = split_held_out(reconstruction.views)[0]
    cameras = (splats.draw_settings.camera(view.camera) for view in views)
    return view_averaged_dc(splats, cameras, settings.backend)


def _bytes(splats: Splats) -> int:
    """The size of the splats in float32: 11 values each, and the SH coefficients of the highest
    degree, as most formats hold them. Lower degrees help only formats that compress zeros."""
    found: int = 4 * len(splats) * (11 + 3 * splats.sh.shape[1])
    return found


def _measures(
    reconstruction: Reconstruction,
    draw_settings: DrawSettings,
    settings: QuantiseSettings,
    report: Report,
) -> tuple[_Measure, _Measure]:
    """(what decides: training views; what evaluates: held-out views if a pixel of any counts)."""
    training, held_out = split_held_out(reconstruction.views)
    if not training:
        raise RunFolderError(
            "quantise-no-views",
            given="The reconstruction has no photographs.",
            wanted="At least one, to measure on.",
            hint="Run `splat sfm` again.",
        )
    deciding = tuple(evenly_spaced(training, DECIDING_VIEWS))
    subset = [held_out[i] for i in evaluation_subset(len(held_out))]
    folder, backend = reconstruction.folder, settings.backend
    decider, evaluator = (
        load_evaluation_views(folder, views, draw_settings, report.stop_requested)
        for views in (deciding, subset)
    )
    what = "held out"
    if not any(view.counts for view in evaluator):  # none is held out, or masks leave nothing
        evaluator, what = decider, "training"
    # As it is, three lower degrees, each threshold, and about as many bit depths.
    planned = 5 + len(_THRESHOLDS_OF_255) + _BIT_DEPTH_MEASUREMENTS * (_SOG in settings.formats)
    return _Measure(decider, backend, report, planned), _Measure(
        evaluator, backend, Report(), what=what
    )


@dataclass
class _Measure:
    """Measures splats on views that are loaded once. planned: about how many times."""

    views: Sequence[EvaluationView]
    backend: str
    report: Report
    planned: int = 0
    what: str = "training"
    done: int = 0

    def psnr(self, splats: Splats, scale: float = 1.0) -> float:
        """Mean PSNR over the views at `scale` times their size (dB)."""
        mean = round(mean_psnr_db(splats, self.views, self.backend, scale), 4)
        self.done += 1
        total = max(self.planned, self.done)
        self.report.progress(self.done, total, "measuring", psnr_db=mean)
        return mean

    def psnr_at_sizes(self, splats: Splats, stem: str) -> dict[str, float]:
        """Mean PSNR at each of `SIZES`, by the name of the metric. A smaller size is left out if no
        pixel of it is compared, as beside thin masks."""
        return {
            psnr_name(size, stem): self.psnr(splats, scale)
            for size, scale in SIZES.items()
            if scale == 1 or any(view.scaled(scale).counts for view in self.views)
        }


def _save(folder: Path, quantised: QuantisedSplats, decisions: Mapping[str, object]) -> None:
    """decisions: what people read of them, and "bits" and "drawing", which `load` reads."""
    if quantised.limit is not None:
        decisions = {**decisions, "limit": asdict(quantised.limit)}
    shutil.rmtree(folder / _FINETUNED, ignore_errors=True)  # of an interrupted run
    save_splats(folder, quantised.splats)
    text = json.dumps(decisions, indent=1) + "\n"
    (folder / _DECISIONS).write_text(text, encoding="utf-8")
    if quantised.flat_dc is not None:
        with replacing(folder / _FLAT) as path, path.open("wb") as file:
            np.save(file, quantised.flat_dc)
    held = dict(quantised.finetuned) | ({} if quantised.plain is None else {PLAIN: quantised.plain})
    for name, splats in held.items():
        (folder / _FINETUNED / name).mkdir(parents=True, exist_ok=True)
        save_splats(folder / _FINETUNED / name, splats)


def load(folder: Path) -> QuantisedSplats:
    """The decision in a finished folder. Raises SplatError if it is damaged."""
    splats = load_splats(folder)
    finetuned = {
        path.name: load_splats(path)
        for path in sorted((folder / _FINETUNED).glob("*"))
        if path.is_dir()
    }
    with reading(folder / _DECISIONS, stage_output("quantise-folder-damaged")):
        decisions = json.loads((folder / _DECISIONS).read_text(encoding="utf-8"))
        flat = np.load(folder / _FLAT) if (folder / _FLAT).exists() else None
        limit = decisions.get("limit")
        return QuantisedSplats(
            splats,
            decisions["bits"],
            flat,
            plain=finetuned.pop(PLAIN, None),
            finetuned=finetuned,
            drawing=decisions["drawing"],
            limit=None if limit is None else SizeLimit(**limit),
        )
