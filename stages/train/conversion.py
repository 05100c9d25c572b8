"""Conversion of `Splats`, which stages exchange, to `Model`, which is optimised, and back."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stages.scene import DrawSettings, Splats, morton
from stages.train.optimiser import Model, new_model


def model_of(splats: Splats) -> Model:
    """A copy of the splats as a model without optimiser state; all have SH coefficients up to
    `splats.sh_degree`."""
    return new_model(*(np.array(a, np.float32, order="C") for a in splats.arrays))


def initial_model(start: Splats, sh_degree: int, cap: int) -> Model:
    """The model that training starts from: at most `cap` of the splats, evenly chosen, in Morton
    order and with SH coefficients up to `sh_degree`."""
    start = start.with_sh_degree(sh_degree)
    if len(start) > cap:
        start = start.take(np.linspace(0, len(start) - 1, cap).round().astype(np.int64))
    return model_of(start.take(morton.morton_order(start)))


def splats_of(model: Model, sh_degree: int, start: Splats, draw_settings: DrawSettings) -> Splats:
    """The model as splats with unit quaternions, without rows that are not finite. start: has the
    origin of their coordinates."""
    norms, valid = _norms(model), valid_rows(model)
    return Splats(
        model.means[valid],
        (model.quaternions[valid] / norms[valid]).astype(np.float32),
        model.log_scales[valid],
        model.opacity_logits[valid],
        model.sh[valid],
        np.full(int(valid.sum()), sh_degree, np.uint8),
        start.origin,
        draw_settings,
    )


def valid_rows(model: Model) -> NDArray[np.bool_]:
    """[N] whether all parameters of a splat are finite, and its quaternion is not 0."""
    norms = _norms(model)[:, 0]
    valid = np.isfinite(norms) & (norms > 0)
    for array in model.arrays:
        valid &= np.isfinite(array).all(tuple(range(1, array.ndim)))
    return np.asarray(valid)


def _norms(model: Model) -> NDArray[np.float64]:
    """[N, 1] of the quaternions."""
    return np.asarray(np.linalg.norm(model.quaternions.astype(np.float64), axis=1, keepdims=True))
