"""Settings of the first splats. Imports neither NumPy nor torch."""

from __future__ import annotations

from dataclasses import dataclass

from stages.base.settings import setting
from stages.base.stage import Stage, in_module


@dataclass(frozen=True)
class SeedSettings:
    """Settings of the initial splats."""

    fill: bool = setting(True, "Add splats where photographs show surfaces without points.")


STAGE = Stage(
    "seed",
    version=8,
    reads=("sfm",),
    settings_type=SeedSettings,
    **in_module("stages.seed.stage"),
)
