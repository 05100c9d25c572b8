"""The average of the parameters over the end of a run (Izmailov et al. 2018, "Averaging Weights
Leads to Wider Optima and Better Generalization").

Learning rates do not fall as far as the last step alone would need (`schedule`). What they leave of
the noise of single views goes with the average, and splats are still moved by all views in turn.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from stages.train.optimiser import Model

AVERAGED_FROM = 0.9  # share of the run
PARTS = 200  # of the run: the model after each of them is averaged from there on


@dataclass
class ParameterAverage:
    """A running average of the parameters of models with the same rows.

    Args:
        count: number of models.
        arrays: their mean, in the order of `Model.arrays`.
    """

    count: int = 0
    arrays: list[NDArray[np.float32]] = field(default_factory=list)

    def add(self, model: Model) -> None:
        """Add a model on the host. If it has not the rows of those before, the average begins with
        it: a GPU whose memory was full holds fewer."""
        if not self.count or len(self.arrays[0]) != len(model):
            self.count, self.arrays = 0, [np.zeros_like(array) for array in model.arrays]
        self.count += 1
        with np.errstate(over="ignore", invalid="ignore"):  # such splats are left out at the end
            for mean, array in zip(self.arrays, model.arrays, strict=True):
                mean += (array - mean) * np.float32(1.0 / self.count)

    def written_to(self, model: Model) -> Model:
        """The model, with its parameters replaced by the average of the models so far."""
        for array, mean in zip(model.arrays, self.arrays, strict=True):
            array[:] = mean
        return model
