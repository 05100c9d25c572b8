"""The stages of the pipeline, in order."""

from __future__ import annotations

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
