"""Small models, views and rules that steps on a device are tried with."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from stages.raster.definition import RasterSettings, splat_arrays
from stages.scene import IGNORE
from stages.train.cap import most_opaque
from stages.train.density import AdaptiveDensity, BoundedDensity, cull
from stages.train.free_space import known_free_space
from stages.train.loss import channel_means
from stages.train.optimiser import LearningRates, Model, new_model
from stages.train.steps.step import StepInput, TrainingStep
from stages.train.views import Level
from tests.scenes import camera, cloud


def level(size=(40, 30), seed=0) -> Level:
    pixels = np.random.default_rng(seed).integers(0, 256, (3, size[1], size[0])).astype(np.uint8)
    return Level(camera(*size), pixels, channel_means(pixels))


def masked(outside: str, light: tuple[float, float, float] | None) -> Level:
    plain = level()
    mask = np.where(np.arange(40) < 25, 255, 0).astype(np.uint8)[None] * np.ones((30, 1), np.uint8)
    return Level(plain.camera, plain.pixels, plain.means, mask, outside, light)


def start(n=20) -> Model:
    found = new_model(*(a.copy() for a in splat_arrays(cloud(n, 40, 30, degree=1, seed=4))))
    found.distances[:] = np.linspace(0.1, 5.0, n)
    return found


def losses_where_masked_later(known: TrainingStep, fresh: TrainingStep) -> tuple[float, float]:
    """Of a view that has become masked: of a step that knew it whole and forgot it, and of one that
    never saw it."""
    plain, settings, rates = level(), RasterSettings(near=0.1, sh_degree=1), LearningRates()
    now = replace(plain, mask=masked(IGNORE, None).mask, outside=IGNORE)
    known.step(StepInput(plain, settings, rates))
    known.load(start())
    known.forget_views()
    return known.step(StepInput(now, settings, rates)), fresh.step(StepInput(now, settings, rates))


def used_model(n: int = 300, degree: int = 1) -> Model:
    """With moments and counters, as after some steps, and two values that are no numbers."""
    r = np.random.default_rng(5)
    found = new_model(*(a.copy() for a in splat_arrays(cloud(n, 40, 30, degree, seed=4))))
    for name in ("moment1", "moment2", "gradient_sum", "smoothing", "distances"):
        array = getattr(found, name)
        array[:] = r.random(array.shape) * 4e-3
    found.steps[:] = r.integers(0, 9, found.steps.shape)
    found.gradient_count[:] = r.integers(0, 20, n)
    found.sh_degrees[: n // 2] = 0
    found.means[3], found.sh[7, 1, 2] = np.inf, np.nan
    return found


def cameras(n: int = 6):
    found = []
    for k in range(n):
        pose = np.eye(4)
        pose[:3, 3] = 0.3 * k, -0.2 * k, 0.5 * k - 1.0
        found.append(camera(40, 30, matrix=pose))
    return found


def densified(rule, model: Model) -> Model:
    return rule.grow(cull(model), 340).in_morton_order()


def floaters_removed(space, model: Model) -> Model:
    return model.take(~model.in_free_space(space))


ADAPTIVE = AdaptiveDensity(12)


def curvature_forgotten(model: Model) -> Model:
    model.reset_moment2()
    return model.take(np.arange(len(model) - 1))


EVENTS: dict[str, Callable[[Model], Model]] = {
    "densification": partial(densified, ADAPTIVE),
    "in a part": partial(densified, BoundedDensity(ADAPTIVE, (-1.0, 0.0, 1.0, 4.0))),
    "floaters": partial(
        floaters_removed, known_free_space(3 * cloud(300, 40, 30, seed=9).means, cameras(3))
    ),
    "fewest": partial(most_opaque, cap=100),
    "curvature": curvature_forgotten,
    "twice": lambda model: densified(ADAPTIVE, densified(ADAPTIVE, model)),
}
