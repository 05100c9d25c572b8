"""Photographs in training that are made here."""

from __future__ import annotations

import numpy as np

from stages.scene import Camera
from stages.train.cap import Cap
from stages.train.loss import channel_means
from stages.train.schedule import SCALES
from stages.train.trainer import Trainer, TrainingTask
from stages.train.views import Level, TrainingView


def view_of(name: str, picture: np.ndarray, where: Camera) -> TrainingView:
    """A training view of one picture [H, W, 3] at all levels (the same size)."""
    pixels = np.ascontiguousarray((picture * 255).round().astype(np.uint8).transpose(2, 0, 1))
    level = Level(where, pixels, channel_means(pixels))
    return TrainingView(name, tuple(level for _ in SCALES))


def trainer_of(
    schedule, views, held_out, draw_settings, cap, folder, report, refinement=None, **more
):
    """A training run with at most `cap` splats; the others: see `TrainingTask` and `Trainer`."""
    task = TrainingTask(views, held_out, draw_settings, folder, report, **more)
    return Trainer(task, schedule, Cap(cap, "--max-splats"), refinement)
