"""The stages of the pipeline, in order."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from stages.base.stage import Stage
from stages.export.settings import STAGE as EXPORT
from stages.ingest.settings import STAGE as INGEST
from stages.prune.settings import STAGE as PRUNE
from stages.quantise.settings import STAGE as QUANTISE
from stages.seed.settings import STAGE as SEED
from stages.sfm.settings import STAGE as SFM
from stages.train.settings import STAGE as TRAIN

STAGES: tuple[Stage, ...] = (INGEST, SFM, SEED, TRAIN, PRUNE, QUANTISE, EXPORT)
STAGE_NAMES = tuple(stage.name for stage in STAGES)
STAGE_OF = {stage.name: stage for stage in STAGES}
# Options that several stages have, and the stages that a command for a whole run gives them to.
SHARED_OPTIONS = {
    "seed": ("sfm", "train"),  # of every random choice
    "allow_partial": ("sfm", "prune"),  # use what failed a check
    "max_splats": ("train",),  # what `prune` is given by itself is a target, whatever the loss
    "splats": ("seed", "train"),  # brought into the run's world, and trained from
    "densify": ("seed", "train"),  # first splats where given ones leave holes, and splits
    "seconds": ("train", "prune"),  # divided among them, see `pipeline.within_limit`
    "formats": ("quantise", "export"),  # what is fine-tuned to, and what is written
    "drawing": ("train", "quantise", "export"),  # trained for, fine-tuned for, and written for it
    "backend": ("train", "prune", "quantise", "export"),
}


def options_of(stage: str, given: Mapping[str, Any]) -> dict[str, Any]:
    """Those of the options `given` for a whole run that the stage gets, by name."""
    every = (stage,)
    return {name: v for name, v in given.items() if stage in SHARED_OPTIONS.get(name, every)}
