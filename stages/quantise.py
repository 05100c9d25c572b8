"""Splats + photographs -> QuantisedSplats: what to keep at which precision, by measurement.

View-dependent colour takes up to three quarters of a file. It is cut, for all splats and then for
each, as far as training photographs do not show it; held-out ones only judge what came of it. And
what the 8-bit .splat costs is measured, so that nobody has to guess.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stages.base.errors import Family, SplatError
from stages.base.stage import Report, Stage
from stages.capacity.usual import DECIDING, SOG_LOSS_DB
from stages.raster.backends import (
    backend_of_settings,
    backend_setting,
    device_setting,
    report_backend,
)

if TYPE_CHECKING:
    from stages.measure.evaluation import EvaluationView
    from stages.scene import DrawSettings, QuantisedSplats, Reconstruction, Splats

_DECISIONS, _FLAT = "decisions.json", "flat_dc.npy"
# Colour that a splat may lose with its higher bands, in steps of 8 bits; the largest that passes.
_THRESHOLDS_OF_255 = (8.0, 4.0, 2.0, 1.0, 0.5, 0.25)
_BIT_TRIALS = 25  # about as many as are made


@dataclass(frozen=True)
class QuantiseSettings:
    """Settings of the choice of precision."""

    max_loss_db: float = field(
        default=0.02,
        metadata={
            "help": "PSNR of training photographs that smaller files may cost (dB).",
            "min": 0,
            "max": 100,
        },
    )
    sog_loss_db: float = field(
        default=SOG_LOSS_DB,
        metadata={
            "help": "PSNR of training photographs that fewer bits in a .sog may cost besides, "
            "before fine-tuning at export finds some of it back (dB).",
            "min": 0,
            "max": 100,
        },
    )
    max_views: int = field(
        default=DECIDING,
        metadata={"help": "Training photographs to decide by, at most.", "min": 1, "max": 100_000},
    )
    backend: str = backend_setting()
    device: str = device_setting()


def run(
    inputs: Mapping[str, Any], settings: QuantiseSettings, folder: Path, report: Report
) -> QuantisedSplats:
    """Decide on the splats of inputs["prune"] by training views of inputs["sfm"].

    Metrics: psnr_raw_db, psnr_kept_db, psnr_splat32_db (means over the held-out views, or over
    those that decided where none are held out), sh_degree, splats_by_sh_degree, raw_mib, kept_mib.
    Raises SplatError if a photograph cannot be read.
    """
    import numpy as np

    from stages.base.atomic import replacing
    from stages.capacity.bits import choose_bits
    from stages.formats import FORMATS, splat32
    from stages.formats.quantisation import splats_to_write
    from stages.measure.sh import view_averaged_dc
    from stages.scene import QuantisedSplats, save_splats, split_held_out

    splats: Splats = inputs["prune"]
    decider, judge = _measures(inputs["sfm"], splats.draw_settings, settings, report)
    raw_db = decider.psnr(splats)
    by_degree = {splats.sh_degree: raw_db}
    kept = splats
    for lower in range(splats.sh_degree):
        candidate = splats.with_sh_degree(lower)
        by_degree[lower] = decider.psnr(candidate)
        if raw_db - by_degree[lower] < settings.max_loss_db:
            kept = candidate
            break
    kept, threshold = _cut_each(kept, raw_db, settings, decider)
    flat = None
    if kept.sh_degree:
        views = split_held_out(inputs["sfm"].views)[0]
        flat = view_averaged_dc(
            kept,
            (kept.draw_settings.camera(v.camera) for v in views),
            backend_of_settings(settings),
        )
    drawn = splats_to_write(FORMATS["splat"], QuantisedSplats(kept, kept.sh_degree, {}, flat))
    in_32_bytes = splat32.decode(splat32.encode(drawn))
    judged = {
        "psnr_raw_db": judge.psnr(splats),
        "psnr_kept_db": judge.psnr(kept),
        "psnr_splat32_db": judge.psnr(replace(in_32_bytes, draw_settings=splats.draw_settings)),
    }

    counts = [int((kept.sh_degrees == d).sum()) for d in range(kept.sh_degree + 1)]
    bits, sog_db = choose_bits(kept, decider.psnr, settings.sog_loss_db)
    decisions: dict[str, object] = {
        "sh_degree": kept.sh_degree,
        "bits": bits,
        "psnr_sog_training_db": sog_db,
        "splats_by_sh_degree": counts,
        "max_loss_db": settings.max_loss_db,
        "colour_loss_of_255": threshold,
        "measured_on": judge.what,
        "views": len(decider.photographs),
        "psnr_by_sh_degree_db": {str(d): by_degree[d] for d in sorted(by_degree)},
        **judged,
    }
    for name in ("psnr_raw_db", "psnr_kept_db", "psnr_splat32_db", "sh_degree"):
        report.metric(name, decisions[name])
    report.metric("splats_by_sh_degree", counts)
    report.metric("bits", bits)
    report.metric("raw_mib", round(_bytes(splats) / 2**20, 3))
    report.metric("kept_mib", round(_bytes(kept) / 2**20, 3))
    report.metric("measured_on", judge.what)
    report.metric("judged_side_px", splats.draw_settings.side)
    report_backend(report, backend_of_settings(settings))
    save_splats(folder, kept)
    (folder / _DECISIONS).write_text(json.dumps(decisions, indent=1) + "\n", encoding="utf-8")
    if flat is not None:
        with replacing(folder / _FLAT) as path, path.open("wb") as file:
            np.save(file, flat)
    return QuantisedSplats(kept, kept.sh_degree, decisions, flat)


def _cut_each(
    kept: Splats, raw_db: float, settings: QuantiseSettings, decider: _Measure
) -> tuple[Splats, float]:
    """(splats with each one's negligible bands cut, the threshold that passed)."""
    import numpy as np

    from stages.measure.sh import sufficient_degrees, truncate_sh

    if kept.sh_degree == 0:
        return kept, 0.0
    for steps in _THRESHOLDS_OF_255:
        degrees = sufficient_degrees(kept, steps / 255)
        if np.array_equal(degrees, kept.sh_degrees):
            continue
        candidate = truncate_sh(kept, degrees)
        if raw_db - decider.psnr(candidate) < settings.max_loss_db:
            return candidate, steps
    return kept, 0.0


def _bytes(splats: Splats) -> int:
    """As float32 with the same bands for all, which is what most formats hold (and 11 numbers
    besides); each splat's own degree only helps formats that compress zeros away."""
    found: int = 4 * len(splats) * (11 + 3 * splats.sh.shape[1])
    return found


def _measures(
    reconstruction: Reconstruction,
    draw_settings: DrawSettings,
    settings: QuantiseSettings,
    report: Report,
) -> tuple[_Measure, _Measure]:
    """(what decides, what judges): training photographs, and those held out if there are any."""
    from stages.measure.evaluation import load_evaluation_views
    from stages.scene import evenly_spaced, split_held_out

    training, held = split_held_out(reconstruction.views)
    if not training:
        raise SplatError(
            "quantise-no-views",
            given="The reconstruction has no photographs.",
            wanted="At least one, to measure on.",
            hint="Run `splat sfm` again.",
            family=Family.RUN_FOLDER,
        )
    lent = tuple(evenly_spaced(training, settings.max_views))
    judges, what = (held, "held out") if held else (lent, "training")
    decider = _Measure(
        load_evaluation_views(reconstruction.folder, lent, draw_settings), settings, report
    )
    judge = _Measure(
        load_evaluation_views(reconstruction.folder, judges, draw_settings),
        settings,
        Report(),
        what,
    )
    return decider, judge


@dataclass
class _Measure:
    """Measures splats on photographs that are loaded once."""

    photographs: Sequence[EvaluationView]
    settings: QuantiseSettings
    report: Report
    what: str = "training"
    done: int = 0

    def psnr(self, splats: Splats) -> float:
        """Mean PSNR over the photographs (dB)."""
        from stages.measure.evaluation import mean_psnr_db

        mean = round(mean_psnr_db(splats, self.photographs, backend_of_settings(self.settings)), 4)
        self.done += 1
        # Raw, three lower degrees, each threshold, and about as many numbers of bits.
        total = 5 + len(_THRESHOLDS_OF_255) + _BIT_TRIALS
        self.report.progress(self.done, max(total, self.done), "measuring", psnr_db=mean)
        return mean


def load(folder: Path) -> QuantisedSplats:
    """The decision in a finished folder. Raises SplatError if it is damaged."""
    import numpy as np

    from stages.scene import QuantisedSplats, load_splats

    splats = load_splats(folder)
    try:
        decisions = json.loads((folder / _DECISIONS).read_text(encoding="utf-8"))
        flat = np.load(folder / _FLAT) if (folder / _FLAT).exists() else None
        return QuantisedSplats(splats, int(decisions["sh_degree"]), decisions, flat)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise SplatError(
            "quantise-folder-damaged",
            given=f"{folder / _DECISIONS} cannot be read: {error}.",
            wanted="The file that the stage wrote.",
            hint="Delete the stage's folder and run the command again.",
            family=Family.RUN_FOLDER,
        ) from error


STAGE = Stage(
    name="quantise",
    version=6,
    reads=("sfm", "prune"),
    settings_type=QuantiseSettings,
    run=run,
    load=load,
)
