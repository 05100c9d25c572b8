"""Settings of the first splats. Imports neither NumPy nor torch."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from stages.base.bad_files import reading
from stages.base.errors import UsageError
from stages.base.settings import setting
from stages.base.stage import Stage, in_module
from stages.formats.format_table import format_of

SPLATS_OF_A_STAGE = "splats.bin"  # in the folder of a stage, as `scene.storage` names it


@dataclass(frozen=True)
class SeedSettings:
    """Settings of the initial splats."""

    splats: Path | None = setting(
        None,
        "Splats to start from, which are not trained unless --steps asks for it: what another "
        "program trained with --cameras, in any format that is read, or an earlier run.",
        panel="Known cameras",
        affects_output=False,  # its content does, and that is an input
    )
    fill: bool = setting(True, "Add splats where photographs show surfaces without points.")
    densify: bool = setting(
        False,
        "Add first splats to --splats where these leave photographs uncovered.",
        panel="Known cameras",
        needs="splats",
    )


STAGE = Stage(
    "seed",
    version=14,
    reads=("sfm",),
    settings_type=SeedSettings,
    **in_module("stages.seed.stage"),
)


def run_of(splats: Path) -> Path | None:
    """The run folder whose stage wrote the file `splats`; None for that of another program."""
    return splats.parent.parent if splats.name == SPLATS_OF_A_STAGE else None


def check_given(path: Path, has_cameras: bool) -> None:
    """Raise SplatError for `--splats` that no run could use: "splats-unreadable" for a file that is
    not there, as `format_of`, and "seed-splats-without-cameras"."""
    if run_of(path) is not None:
        return
    with reading(path):
        format_of(path)
    if not has_cameras:
        raise UsageError(
            "seed-splats-without-cameras",
            given=f"The splats of {path} are in the world of the cameras that they were trained "
            "with, and this run would estimate its own.",
            wanted="The cameras of the program that trained the splats.",
            hint="Add --cameras with the COLMAP model or transforms.json that it was given.",
        )
