"""Splats that learn to live with what a file rounds.

One kind of value after the other is rounded as the file will, stands still from then on, and the
others make up for it.

Rounding through which gradients pass as if it were not there (Bengio et al. 2013) was tried
instead: on the sample it found nothing back, for values that swing between two steps disturb the
others.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages import formats
from stages.base.lazy import load_object
from stages.formats.axes import smallest_rotations
from stages.formats.quantisation import BitDepths, quantise_splats, splats_to_write
from stages.formats.table import Format
from stages.measure.evaluation import EvaluationView, mean_psnr_db
from stages.scene import QuantisedSplats, Splats
from stages.training.finetune import FineTuner

# Fields of `LearningRates`, what others can make up for least first; colour last, which is rounded
# finely and in which the picture is linear.
ORDER = ("sh_rest", "opacity_logits", "quaternions", "means", "log_scales", "sh_dc")

Rounded = Callable[[Splats], Splats]  # what a file holds of them, row by row


@dataclass
class Fitting:
    """Fits splats to what files round. tuner: on the photographs of training; deciding: those of
    them that tell whether it was worth it. steps: see `tuned_to`; seen: see `Tuner.tuned`."""

    tuner: FineTuner
    deciding: Sequence[EvaluationView]
    backend: str
    steps: int
    seen: NDArray[np.int32]

    def fitted(self, row: Format, quantised: QuantisedSplats) -> tuple[Splats, dict[str, Any]]:
        """(what a file of the format should hold, figures: PSNR of the photographs that decide, as
        the file would be drawn without fine-tuning and with it). Raises Interrupted."""
        self.tuner.steps = 0  # what a file holds does not depend on those written before it
        plain = splats_to_write(row, quantised)
        exact = splats_to_write(row, replace(quantised, decisions={}))
        bits = quantised.decisions.get("bits")

        def read(splats: Splats) -> Splats:
            return as_read(row, splats)

        if row.quantiser and isinstance(bits, dict):
            exact, few = smallest_rotations(exact), BitDepths(**bits)
            found = tuned_to(
                lambda s: quantise_splats(s, few), exact, self.tuner, self.steps, self.seen
            )
        else:
            found = tuned_to(read, exact, self.tuner, self.steps, self.seen)
        before, after = (
            mean_psnr_db(read(splats), self.deciding, self.backend) for splats in (plain, found)
        )
        figures = {"plain_db": round(before, 3), "fitted_db": round(after, 3)}
        return (found if after > before else plain), figures


def tuned_to(
    rounded: Rounded, splats: Splats, tuner: FineTuner, steps: int, seen: NDArray[np.int32]
) -> Splats:
    """Splats that `rounded` leaves nearly as they are. steps: after each kind of value that it
    changes. Raises Interrupted."""
    still: list[str] = []
    for name in ORDER:
        coarse = _only(name, rounded(splats), splats)
        if _equal(name, coarse, splats):
            continue  # told as it is: it goes on learning
        splats = coarse
        still.append(name)
        if name != ORDER[-1]:
            splats = tuner.finetune(splats, steps, seen, still)
    return splats


def as_read(row: Format, splats: Splats) -> Splats:
    """What a file of them says, in their order. All rows must be drawable."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / row.file_name("scene")
        formats.write(path, splats)
        read = formats.read(path)
    found = read.with_sh_degree(splats.sh_degree)
    if row.order:
        places = np.argsort(load_object(row.order)(splats))
        found = found.take(places)
    return replace(found, draw_settings=splats.draw_settings, origin=splats.origin)


def _only(name: str, coarse: Splats, splats: Splats) -> Splats:
    """`splats` with one kind of value of `coarse`; degrees stay."""
    if not name.startswith("sh_"):
        return replace(splats, **{name: getattr(coarse, name)})
    bands = _bands(name)
    sh = splats.sh.copy()
    sh[:, bands] = coarse.sh[:, bands]
    return replace(splats, sh=sh)


def _equal(name: str, a: Splats, b: Splats) -> bool:
    if not name.startswith("sh_"):
        return np.array_equal(getattr(a, name), getattr(b, name))
    bands = _bands(name)
    return np.array_equal(a.sh[:, bands], b.sh[:, bands])


def _bands(name: str) -> slice:
    return slice(0, 1) if name == "sh_dc" else slice(1, None)
