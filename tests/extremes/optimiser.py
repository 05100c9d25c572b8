"""Row 28: the first step of a splat that is seen late."""

from __future__ import annotations

import numpy as np

from stages.kernels.pool import Pool
from stages.raster.definition import Backward, gradient_columns
from stages.training.optimiser import LearningRates, apply_gradients, new_model
from tests.extremes.measured import Measured, worst
from tests.tolerances import FIRST_STEP

RATES, BANDS = LearningRates(means=0.01), 4
USED = 11 + 3 * BANDS


def first_seen_late(backend):
    """Row 0 is seen for 999 steps; at step 1000 row 1 is, for the first time."""
    r = np.random.default_rng(0)
    shapes = ((2, 3), (2, 4), (2, 3), (2,), (2, BANDS, 3))
    model = new_model(*(r.normal(size=shape).astype(np.float32) for shape in shapes))
    pool = Pool(1)
    for _ in range(999):
        _step(pool, model, 0, r.normal(size=USED))
    before = _row(model, 1)
    _step(pool, model, 1, r.choice([-1.0, 1.0], USED) * r.uniform(50.0, 100.0, USED))
    strides = np.abs(_row(model, 1) - before) / RATES.row(BANDS)[:USED]
    return [Measured(28, "first step over its rate, less 1", worst(abs(strides - 1)), FIRST_STEP)]


def _step(pool, model, row, gradient):
    values = np.zeros((1, gradient_columns(BANDS)), np.float32)
    values[0, :USED] = gradient
    backward = Backward(np.array([row], np.int32), values, np.zeros((1, 2), np.float32))
    apply_gradients(pool, model, backward, BANDS, RATES, 100, 50)


def _row(model, row):
    return np.concatenate([array[row].reshape(-1) for array in model.arrays]).astype(np.float64)
