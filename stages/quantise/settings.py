"""Settings of the choice of precision. Neither NumPy nor torch is imported for them."""

from __future__ import annotations

from dataclasses import dataclass

from stages.base.settings import setting
from stages.base.stage import Stage, in_module
from stages.formats.format_table import AUTO
from stages.formats.output_formats import (
    CHOICES,
    DEFAULT_FORMATS,
    drawing_setting,
    formats_setting,
    formats_to_finetune,
)
from stages.prune.settings import SOG_LOSS_DB
from stages.raster.backends import backend_setting


@dataclass(frozen=True)
class QuantiseSettings:
    """Settings of the choice of precision. Of the formats, only those that need fine-tuning are
    kept: a further lossless format changes nothing here."""

    sh_loss_db: float = setting(
        0.02, "PSNR of training views that lower SH degrees may cost (dB).", min=0, max=100
    )
    sog_loss_db: float = setting(
        SOG_LOSS_DB,
        "PSNR of training views that fewer bits in a .sog may cost besides, before "
        "fine-tuning recovers a part of it (dB).",
        min=0,
        max=100,
    )
    formats: tuple[str, ...] = formats_setting(
        formats_to_finetune(DEFAULT_FORMATS, AUTO),
        "File format to fine-tune the splats to; repeatable. Formats that need no fine-tuning "
        "change nothing",
        may_be_empty=True,
    )
    drawing: str = drawing_setting()
    plain_steps: int = setting(
        0,
        "Steps of fine-tuning of antialiased splats for formats that are drawn plainly. 0: a tenth "
        "of the steps of training, and at least 200.",
        min=0,
        max=100_000,
    )
    rounding_steps: int = setting(
        45,
        "Steps of fine-tuning after each attribute that a format rounds (.splat, .spz, "
        ".sog, .compressed.ply); 0 for none.",
        min=0,
        max=100_000,
    )
    backend: str = backend_setting()

    def __post_init__(self) -> None:
        unknown = tuple(name for name in self.formats if name not in CHOICES)  # refused by checks
        known = formats_to_finetune(self.formats, self.drawing)
        object.__setattr__(self, "formats", (*known, *unknown))


STAGE = Stage(
    "quantise",
    version=19,
    reads=("sfm", "train", "prune"),
    settings_type=QuantiseSettings,
    adds="formats",
    **in_module("stages.quantise.stage"),
)
