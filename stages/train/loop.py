"""The training loop of 3D Gaussian splatting (Kerbl et al. 2023): steps, and what happens between
them (`hooks`)."""

from __future__ import annotations

from stages.scene import Splats
from stages.train.hooks import step_hooks
from stages.train.optimiser import Model
from stages.train.trainer import Trainer


def train(trainer: Trainer, start: Splats) -> Model:
    """Train from `start`, or from the checkpoint in the folder, and return the final model.

    Raises Interrupted after a step, with a checkpoint written, if the report asks to stop.
    """
    # compiling the first kernels is a phase of its own, with its own pace
    trainer.task.report.progress(0, 1, "compiling kernels")
    step = trainer.begin(start)
    hooks = step_hooks(trainer, start)
    while step < trainer.schedule.steps:
        trainer.loss = trainer.step(step)
        step += 1
        for hook in hooks:
            hook.after_step(trainer, step)
    return trainer.model
