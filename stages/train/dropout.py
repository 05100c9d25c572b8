"""Dropout: splats are left out of training steps at random (Srivastava et al. 2014; for splats Park
et al. 2025, "DropGaussian").

With few training views, fine splats overfit: they match the pixels of those views and appear as
needles and fog from everywhere else. With dropout, neighbouring splats learn to replace each other.
The dropout probability of a splat that n training views see is (2 / n)^2, at most 0.3: splats that
many views see are hardly ever dropped. n is estimated from the steps in which the splat was drawn,
so it falls for a splat that was dropped: of 12 views, 5 should give 0.16 and give 0.29 in the end.
The gains in docs/experiments/overfitting.md were measured like this.

Neighbours overlap, so what one dropped splat leaves is drawn by those around it. `NEIGHBOURHOOD`
consecutive splats therefore share a random number (Fang et al. 2026, "DropAnSH-GS"): the splats are
in Morton order, so these lie close together.

Only captures of few training views are overfitted, so only they use dropout, once densification has
ended. With more views dropout costs quality (docs/experiments/overfitting.md).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stages.train.density import estimated_view_counts
from stages.train.random_bits import hashed

DROPOUT_BELOW = 15  # training views
VIEW_SCALE = 2.0  # views: the dropout probability is (VIEW_SCALE / n)^2
MAX_PROBABILITY = 0.3
NEIGHBOURHOOD = 8  # consecutive splats that share a random number
INVISIBLE = -20.0  # opacity logit of a dropped splat
_UINT32 = 2.0**32


def uses_dropout(views: int) -> bool:
    """Whether a run with this many training views overfits them, and so uses dropout."""
    return views < DROPOUT_BELOW


@dataclass(frozen=True)
class Dropout:
    """The dropout of one step.

    Args:
        views: number of training views.
        key: 32 random bits that choose the dropped splats.
    """

    views: int
    key: int

    def dropped(self, counts: NDArray[np.int32]) -> NDArray[np.bool_]:
        """[N] which splats are dropped. counts [N]: see `density.estimated_view_counts`."""
        seen_by = estimated_view_counts(counts, self.views)
        probability = np.minimum(MAX_PROBABILITY, np.square(VIEW_SCALE / np.maximum(seen_by, 1.0)))
        return np.asarray(noise(len(counts), self.key) < probability * _UINT32)


def noise(n: int, key: int) -> NDArray[np.uint32]:
    """[n] uniform over 32 bits, equal for all splats of a neighbourhood: `hashed` of its number."""
    return hashed(np.arange(n, dtype=np.uint32) // np.uint32(NEIGHBOURHOOD), key)
