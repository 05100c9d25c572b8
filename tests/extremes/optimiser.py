"""Rows 28, 33 and 34: first steps of what is seen or switched on late; gradients out of range."""

from __future__ import annotations

import numpy as np

from stages.raster.definition import OPACITY, SH_REST, Backward, gradient_columns, used_columns
from stages.raster.kernels.pool import Pool
from stages.train.optimiser import OPACITY_STEPS, LearningRates, apply_gradients, new_model
from tests.extremes.measured import Measured, broken, worst
from tests.tolerances import FIRST_STEP

RATES, COEFFICIENTS = LearningRates(means=0.01), 4
USED = used_columns(COEFFICIENTS)


def first_seen_late(backend):
    """Row 0 is seen for 999 steps; at step 1000 row 1 is, for the first time."""
    r = np.random.default_rng(0)
    model, pool = _model(r), Pool(1)
    for _ in range(999):
        _step(pool, model, 0, r.normal(size=USED))
    strides = _strides(pool, model, 1, _strong(r))
    return [Measured(28, "first step over its rate, less 1", worst(abs(strides - 1)), FIRST_STEP)]


def out_of_range(backend):
    """One gradient as large as given, after 99 ordinary steps and before 100 more."""
    broken_moments, still = 0, 0
    for size in (1e13, 1e19, 1e21, 1e29, 3e38, np.inf, np.nan):
        r = np.random.default_rng(0)
        model, pool = _model(r), Pool(1)
        for _ in range(99):
            _step(pool, model, 0, r.normal(size=USED))
        _step(pool, model, 0, np.full(USED, size, np.float32))
        broken_moments += broken(model.moment1, model.moment2)
        before = _row(model, 0)
        for _ in range(100):
            _step(pool, model, 0, np.ones(USED))
        moved = np.abs(_row(model, 0) - before) / RATES.row(COEFFICIENTS)[:USED]
        still += int((moved < 10).sum())
    return [
        Measured(33, "moments not finite", broken_moments, 0),
        Measured(33, "values that hardly move afterwards", still, 0),
    ]


def switched_on_late(backend):
    """At step 1000: an SH degree that had no part before; the opacity, begun anew."""
    r = np.random.default_rng(0)
    model, pool = _model(r), Pool(1)
    for _ in range(999):
        _step(pool, model, 0, r.normal(size=used_columns(1)), coefficients=1)
    band = _strides(pool, model, 0, _strong(r))[SH_REST:]
    model.moment1[:, OPACITY] = model.moment2[:, OPACITY] = 0.0
    model.steps[:, OPACITY_STEPS] = 0
    opacity = _strides(pool, model, 0, _strong(r))[OPACITY]
    what = "over its rate, less 1"
    return [
        Measured(34, f"an SH degree's first step {what}", worst(abs(band - 1)), FIRST_STEP),
        Measured(34, f"opacity's first step after a reset {what}", abs(opacity - 1), FIRST_STEP),
    ]


def _model(r):
    shapes = ((2, 3), (2, 4), (2, 3), (2,), (2, COEFFICIENTS, 3))
    return new_model(*(r.normal(size=shape).astype(np.float32) for shape in shapes))


def _strong(r):
    return r.choice([-1.0, 1.0], USED) * r.uniform(50.0, 100.0, USED)


def _strides(pool, model, row, gradient):
    """How far one step takes each value of a row, over its rate."""
    before = _row(model, row)
    _step(pool, model, row, gradient)
    return np.abs(_row(model, row) - before) / RATES.row(COEFFICIENTS)[:USED]


def _step(pool, model, row, gradient, coefficients=COEFFICIENTS):
    values = np.zeros((1, gradient_columns(coefficients)), np.float32)
    values[0, : len(gradient)] = gradient
    backward = Backward(np.array([row], np.int32), values, np.zeros((1, 2), np.float32))
    apply_gradients(pool, model, backward, coefficients, RATES, 100, 50)


def _row(model, row):
    return np.concatenate([array[row].reshape(-1) for array in model.arrays]).astype(np.float64)
