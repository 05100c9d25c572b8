"""Settings of pruning. Neither NumPy nor torch is imported for them."""

from __future__ import annotations

from dataclasses import dataclass

from stages.base.settings import setting
from stages.base.stage import Stage, in_module
from stages.formats.format_table import FORMATS
from stages.raster.backends import backend_setting

SOG_LOSS_DB = 0.3  # PSNR of training views that the bit depths of a .sog file may cost
DECIDING_VIEWS = 12  # training views, at most, on which bit depths are measured


@dataclass(frozen=True)
class PruneSettings:
    """Settings of pruning."""

    rounds: int = setting(
        8, "Rounds of pruning, each of a tenth of the splats at most; 0 for none.", min=0, max=100
    )
    strength: float = setting(
        1.0,
        "Pruning strength: larger removes more, and allows more loss.",
        panel="Size",
        min=0.001,
        max=1000,
    )
    max_loss_db: float = setting(
        0.1,
        "Mean PSNR that held-out views may lose, at strength 1 (dB); none may lose more than 0.3.",
        min=0,
        max=100,
    )
    max_splats: int = setting(
        0, "Splats at most, whatever the loss; 0 for any number.", min=0, max=100_000_000
    )
    max_mb: float = setting(
        0.0,
        "Size at most, whatever the loss, of the file that --mb-of names; 0 for any (megabytes).",
        panel="Size",
        min=0,
        max=1_000_000,
    )
    mb_of: str = setting(
        "ply", "Format that --max-mb is about", panel="Size", choices=tuple(FORMATS)
    )
    min_psnr: float = setting(
        0.0,
        "Remove as much as leaves the training views this PSNR, instead of by "
        "--strength; 0 for none (dB).",
        panel="Size",
        min=0,
        max=99,
    )
    finetune_steps: int = setting(
        90,
        "Steps of fine-tuning after each round that a target needs; 0 for none.",
        panel="Advanced",
        min=0,
        max=100_000,
    )
    seconds: float = setting(
        0.0,
        "Time limit (seconds): afterwards only rounds that --max-splats or --max-mb needs begin. "
        "0: no limit.",
        min=0,
        max=1e7,
    )
    allow_partial: bool = setting(
        False, "Go on with a result that is wrong because photographs contradict each other."
    )
    backend: str = backend_setting()


STAGE = Stage(
    "prune",
    version=29,
    reads=("sfm", "train"),
    settings_type=PruneSettings,
    **in_module("stages.prune.stage"),
)
