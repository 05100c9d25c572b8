"""How many splats there are, and where they are: two verbs, whatever the rule behind them.

A strategy is a small object without a memory: models go in and come out, and what a verb needs to
know of the run it is told. To add one: write the class, and name it in `strategies.STRATEGIES` and
in the setting `TrainSettings.growth`.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from stages.training.optimiser import Model


class Strategy(Protocol):
    """What the trainer asks for after some of its steps. Each returns the model to go on with."""

    def prune(self, model: Model, settled: bool) -> Model:
        """Without what does not show. settled: whether sizes mean something by now."""

    def grow(self, model: Model, budget: int, rng: np.random.Generator) -> Model:
        """With more splats where the photographs ask for them, at most `budget` in all; what was
        added up since the last time is forgotten."""


def photographs_that_see(counts: NDArray[np.int32], photographs: int) -> NDArray[np.float64]:
    """[N] of so many in training, by `counts` [N]: in how many steps each splat was in the picture,
    since they were last counted together; before anything was counted, all."""
    most = int(counts.max(initial=0))
    return np.asarray(photographs * ((counts + 1.0) / (most + 1.0)))
