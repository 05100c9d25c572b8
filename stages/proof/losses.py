"""Why a file of a lossy format differs from its original, for a warning."""

from __future__ import annotations

import numpy as np

from stages.base.text import counted
from stages.formats import Format
from stages.formats.codecs import CODECS
from stages.formats.compressed_ply import outlier_shells
from stages.proof.prover import Proof
from stages.scene import Splats
from stages.scene.quantiles import median_spacing

_DROP = "`splat edit --drop-floaters` removes outliers"


def losses_shown(row: Format, proof: Proof, splats: Splats) -> str:
    """What was lost in a file of the format `row` made from `splats`, and why; "" where the
    pictures agree and half of the positions are right to the distance between neighbours."""
    spacing = median_spacing(splats.means)
    shifted = proof.median_position_error > spacing > 0
    if proof.loss_db is None and not shifted:
        return ""
    found = []
    if proof.loss_db is not None:
        found.append(f"its pictures have a PSNR of {proof.loss_db:.1f} dB")
    if shifted:
        ratio = proof.median_position_error / spacing
        found.append(f"half of the splats are off by {ratio:.1f} distances between neighbours")
    moved = shifted or proof.figures["max_position_error"] > spacing > 0
    return f"{' and '.join(found)}: {_cause(row, splats, moved)}"


def _cause(row: Format, splats: Splats, moved: bool) -> str:
    """moved: whether positions differ by more than the distance between neighbours."""
    if moved and (loss := CODECS[row.ending].position_loss(splats)):
        return f"it {loss}. {_DROP}."
    if moved and (count := int(np.count_nonzero(outlier_shells(splats.means)))):
        return f"{counted(count, 'outlier')} widened the range of its positions. {_DROP}."
    if moved:
        return "its positions have too few bits for splats so close together."
    return f"the format {row.loses}." if row.loses else "the original had lost more already."
