"""Fine-tunes splats to the requested file formats: to being drawn plainly, and to rounding."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from stages.base.stage import Report
from stages.evaluate.contribution import measure_contributions
from stages.evaluate.evaluation import EvaluationView, load_evaluation_views, mean_psnr_db
from stages.formats.axes import smallest_rotations
from stages.formats.format_table import FORMATS, Format
from stages.formats.sog_quantisation import BitDepths, quantise_splats, splats_to_write
from stages.formats.values import drop_undrawable
from stages.quantise.rounding import finetune_to_rounding, write_and_read
from stages.quantise.settings import QuantiseSettings
from stages.raster.compensation import without_compensation
from stages.scene import (
    QuantisedSplats,
    Reconstruction,
    Splats,
    TrainedSplats,
    split_held_out,
    training_extent,
)
from stages.train.finetune import FineTuner

PLAIN_RATES = 3.0, 0.4  # with them 200 steps are as good as 300 with the usual ones
# The longer splats were trained antialiased, the longer they take to adapt.
FEWEST_PLAIN_STEPS, TRAINING_PER_PLAIN_STEP = 200, 10


@dataclass(frozen=True)
class FormatFinetuning:
    """Fine-tunes on the training views.

    Attributes:
        rounding: fine-tunes to the rounding of formats.
        plain: fine-tunes to plain drawing, on views of the size of training and half of it.
        plain_steps: how many steps it makes.
        deciding_views: training views that decide whether fine-tuning to rounding has helped.
        view_counts: [N] in how many views each splat is visible.
        settings, report: of the stage.
    """

    rounding: FineTuner
    plain: FineTuner
    plain_steps: int
    deciding_views: Sequence[EvaluationView]
    view_counts: NDArray[np.int32]
    settings: QuantiseSettings
    report: Report

    @classmethod
    def of(
        cls,
        splats: Splats,
        reconstruction: Reconstruction,
        trained: TrainedSplats,
        settings: QuantiseSettings,
        deciding_views: Sequence[EvaluationView],
        report: Report,
    ) -> FormatFinetuning:
        """For `splats`.

        Args:
            splats: as trained and pruned.
            reconstruction: whose training views are used.
            trained: the result of training: whether it used dropout, and its steps.
            settings: of the stage.
            deciding_views: as in the class.
            report: says before each step whether to stop.
        """
        splats, backend = drop_undrawable(splats)[0], settings.backend
        dropout = trained.dropout
        plain_steps = settings.plain_steps or max(
            FEWEST_PLAIN_STEPS, trained.steps // TRAINING_PER_PLAIN_STEP
        )
        training = split_held_out(reconstruction.views)[0]
        views = load_evaluation_views(
            reconstruction.folder, training, splats.draw_settings, report.stop_requested
        )
        view_counts = np.zeros(len(splats), np.int32)
        if dropout and settings.formats:  # dropout alone depends on them
            view_counts = measure_contributions(splats, views, backend).view_counts
        extent = training_extent(reconstruction)
        rounding = FineTuner(views, extent, backend, report, dropout)
        plain = FineTuner(views, extent, backend, report, dropout, True, PLAIN_RATES)
        return cls(rounding, plain, plain_steps, deciding_views, view_counts, settings, report)

    def to_plain_drawing(self, splats: Splats, earlier: Splats | None = None) -> Splats | None:
        """The splats for formats that are drawn without opacity compensation; None if no such
        format is requested, or `splats` are drawn so. earlier: the same of an earlier run, if it
        made them. Raises Interrupted."""
        rows = [FORMATS[name] for name in self.settings.formats]
        if not splats.draw_settings.antialias or all(
            row.holds_antialiased(self.settings.drawing) for row in rows
        ):
            return None
        if earlier is not None:
            return earlier
        found = without_compensation(drop_undrawable(splats)[0], self.plain.cameras)
        doing = "fine-tuning to plain drawing"
        return self.plain.finetune(found, self.plain_steps, self.view_counts, progress=doing)

    def to_rounding(
        self,
        quantised: QuantisedSplats,
        earlier: Mapping[str, Splats],
        earlier_figures: Mapping[str, dict[str, float]],
    ) -> dict[str, Splats]:
        """By format that rounds, the splats that its file should hold. Metric: formats, by format
        the figures of `to_rounding_of`. earlier, earlier_figures: the same of formats that need not
        be made again. Raises Interrupted."""
        if not (self.settings.rounding_steps and len(drop_undrawable(quantised.splats)[0])):
            return {}
        names = [name for name in self.settings.formats if FORMATS[name].needs_finetuning]
        found, figures = {}, {}
        for number, name in enumerate(names):
            if name in earlier and name in earlier_figures:
                found[name], figures[name] = earlier[name], earlier_figures[name]
                continue
            self.report.progress(number, len(names), f"fine-tuning to .{name}")
            found[name], figures[name] = self.to_rounding_of(FORMATS[name], quantised)
        self.report.metric("formats", figures)
        return found

    def to_rounding_of(
        self, row: Format, quantised: QuantisedSplats
    ) -> tuple[Splats, dict[str, float]]:
        """(the splats that a file of the format should hold; mean PSNR of the deciding views drawn
        from that file, without and with fine-tuning). Raises Interrupted."""
        self.rounding.steps = 0  # so that a file does not depend on those before it
        plain = splats_to_write(row, quantised)
        found = splats_to_write(row, replace(quantised, sog_bits=None))
        written = rounded = partial(write_and_read, row)
        if row.has_bit_depths and quantised.sog_bits is not None:
            found = smallest_rotations(found)
            rounded = partial(quantise_splats, bits=BitDepths(**quantised.sog_bits))
        steps, backend = self.settings.rounding_steps, self.settings.backend
        found = finetune_to_rounding(rounded, found, self.rounding, steps, self.view_counts)
        plain_db, finetuned_db = (
            mean_psnr_db(written(splats), self.deciding_views, backend) for splats in (plain, found)
        )
        figures = {"rounded_db": round(plain_db, 3), "finetuned_db": round(finetuned_db, 3)}
        return (found if finetuned_db > plain_db else plain), figures
