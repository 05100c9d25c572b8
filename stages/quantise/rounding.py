"""Fine-tunes splats to the rounding of a file format.

One attribute after the other is rounded as the file will round it and is frozen from then on, and
the remaining attributes are fine-tuned to compensate.

Rounding through which gradients pass unchanged (the straight-through estimator, Bengio et al. 2013)
was tried instead: on the sample it recovered nothing, because values that alternate between two
quantisation steps disturb the others.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stages import formats
from stages.formats.codecs import CODECS
from stages.formats.format_table import Format
from stages.scene import Splats
from stages.train.finetune import FineTuner

# Parameters (fields of `LearningRates`) in the order in which they are rounded. First those that
# the others compensate for least well; DC colour last: it is rounded finely, and the picture is
# linear in it.
ORDER = ("sh_rest", "opacity_logits", "quaternions", "means", "log_scales", "sh_dc")


def finetune_to_rounding(
    rounded: Callable[[Splats], Splats],
    splats: Splats,
    finetuner: FineTuner,
    steps: int,
    view_counts: NDArray[np.int32],
) -> Splats:
    """The splats, fine-tuned until `rounded` hardly changes them.

    rounded: rounds the values of splats and keeps their rows. steps: of fine-tuning after each
    attribute that it changes. Raises Interrupted."""
    frozen: list[str] = []
    for name in ORDER:
        candidate = _with_attribute(name, splats, rounded(splats))
        if np.array_equal(_attribute(name, candidate), _attribute(name, splats)):
            continue  # stored exactly: it is not frozen
        splats = candidate
        frozen.append(name)
        if name != ORDER[-1]:
            splats = finetuner.finetune(splats, steps, view_counts, frozen)
    return splats


def write_and_read(row: Format, splats: Splats) -> Splats:
    """`splats` as a file of the format returns them, in their own order. All must be drawable."""
    if not len(splats):
        return splats  # no format holds none
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / row.file_name("scene")
        formats.write(path, splats)
        found = formats.read(path).with_sh_degree(splats.sh_degree)
    if order := CODECS[row.ending].order:
        found = found.take(np.argsort(order(splats)))
    drawn = replace(splats.draw_settings, antialias=found.draw_settings.antialias)
    return replace(found, draw_settings=drawn, origin=splats.origin)


def _attribute(name: str, splats: Splats) -> NDArray[np.floating]:
    """The array of a field of `LearningRates`; for SH coefficients, a view."""
    if name == "sh_dc":
        return splats.sh[:, :1]
    if name == "sh_rest":
        return splats.sh[:, 1:]
    return np.asarray(getattr(splats, name))


def _with_attribute(name: str, splats: Splats, source: Splats) -> Splats:
    """`splats` with one attribute of `source`; SH degrees stay."""
    if not name.startswith("sh_"):
        return replace(splats, **{name: getattr(source, name)})
    found = replace(splats, sh=splats.sh.copy())
    _attribute(name, found)[:] = _attribute(name, source)
    return found
