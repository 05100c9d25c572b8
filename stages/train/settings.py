"""Settings of training, and its presets. Neither NumPy nor torch is imported for them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from stages.base.errors import UsageError
from stages.base.settings import setting
from stages.base.stage import Stage, in_module
from stages.formats.format_table import PLAIN
from stages.formats.output_formats import drawing_setting
from stages.raster.backends import backend_setting

# More fit few photographs alone; with many, steps gain the longer the more views there are
# (docs/experiments/densification.md#steps-for-each-training-view).
STEPS_PER_VIEW, STEPS_PER_VIEW_SQUARED = 150, 7


@dataclass(frozen=True)
class TrainSettings:
    steps: int = setting(
        0,
        "Training steps, with one photograph each. 0: --steps-per-view for each training view, "
        "at least 2,000 and at most 30,000; with --splats none.",
        panel="Quality and time",
        min=0,
        max=1_000_000,
    )
    steps_per_view: int = setting(
        STEPS_PER_VIEW,
        "Training steps for each training view where --steps does not give their number, and at "
        f"most where --seconds does. 0: {STEPS_PER_VIEW}, or {STEPS_PER_VIEW_SQUARED} times the "
        "number of training views if that is more.",
        panel="Advanced",
        min=0,
        max=1_000_000,
    )
    train_side: int = setting(
        800,
        "Longer side of the photographs in training (pixels).",
        panel="Quality and time",
        min=16,
        max=8192,
    )
    sh_degree: int = setting(2, "Degree of view-dependent colour, 0 (none) to 3.", min=0, max=3)
    max_splats: int = setting(
        0,
        "Largest number of splats; those that photographs can spare are removed later. 0: what "
        "free memory allows, with no more parameters than the photographs have pixel values.",
        panel="Size",
        min=0,
        max=100_000_000,
    )
    splats_per_view: int = setting(
        0,
        "Largest number of splats for each training view; a --max-splats that is given holds "
        "instead. 0: no such limit.",
        panel="Advanced",
        min=0,
        max=100_000_000,
    )
    seconds: float = setting(
        0.0,
        "Time limit in seconds, of the whole command: training makes as many steps as "
        "fit, whatever --steps says, and pruning as many rounds. 0: no limit.",
        panel="Quality and time",
        min=0,
        max=1e7,
    )
    smooth: bool = setting(
        False,
        "Train under a 3D smoothing filter, so that no detail is finer than the "
        "photographs show: softer from close by, without needles and specks.",
    )
    seed: int = setting(0, "Seed of all random numbers.", min=0, max=2**31 - 1)
    background: str = setting(
        "black",
        "Background in training: black, as in viewers, or any, a random colour at "
        "each step, for scenes that are drawn over others. Cut-out objects always use any.",
        panel="Light and masks",
        choices=("black", "any"),
    )
    light: str = setting(
        "auto",
        "Bring all photographs to the median exposure and white balance "
        "before training: auto (what the points of all parts of the scene agree about) or off.",
        panel="Light and masks",
        choices=("auto", "off"),
    )
    refine_in_training: bool = setting(
        False,
        "Let training move the cameras of its photographs, and one focal length factor for all: "
        "for known cameras that are only nearly right.",
        panel="Known cameras",
    )
    drawing: str = drawing_setting()
    blocks: str = setting(
        "1",
        "Divide the scene into this many blocks, train each on the photographs that "
        "show it, and merge them; auto: one block for about every 250 photographs.",
        panel="Advanced",
        pattern=r"auto|[1-9]\d{0,3}",
        wanted="A whole number of blocks, or auto.",
    )
    within: tuple[float, ...] = setting(
        (),
        "Densify only inside this rectangle of the ground plane (world units); the "
        "rest stays as coarse as it is. 0 0 0 0: everywhere.",
        together="X0 Z0 X1 Z1",
        panel="Advanced",
        min=-1e30,
        max=1e30,
    )
    backend: str = backend_setting()
    splats: Path | None = setting(
        None,
        "The splats of `splat seed` are given ones, which were trained before: only the last part "
        "of a training is made.",
        affects_output=False,  # its content does, and that is an input
    )
    densify: bool = setting(
        False,
        "Go on from --splats with more splats: from the second fifth of a run on, which densifies, "
        "to at most --max-splats. --within does so, too, inside its rectangle.",
        panel="Size",
        needs="splats",
    )

    def __post_init__(self) -> None:
        if self.within == (0, 0, 0, 0):  # takes back a rectangle that was recorded
            object.__setattr__(self, "within", ())

    def check(self) -> None:
        """Raises SplatError "option-value" for a rectangle that is empty or reversed."""
        match self.within:
            case (x0, z0, x1, z1):
                ordered = x0 < x1 and z0 < z1
            case values:
                ordered = not values
        if not ordered:
            raise UsageError(
                "option-value",
                given=f"--within {' '.join(f'{value:g}' for value in self.within)} cannot be used.",
                wanted="X0 Z0 X1 Z1 with X0 less than X1 and Z0 less than Z1, or 0 0 0 0 for none.",
                hint="Give the smaller corner first.",
            )

    @staticmethod
    def completed(given: Mapping[str, Any]) -> dict[str, Any]:
        """The options `given`, by name, with those that follow: the limit of a preset for each view
        does not hold beside a --max-splats that is given."""
        return {"splats_per_view": 0, **given} if given.get("max_splats") else dict(given)

    @property
    def antialias(self) -> bool:
        """Whether splats are trained to be drawn with opacity compensation."""
        return self.drawing != PLAIN


PRESETS: dict[str, TrainSettings] = {
    "preview": TrainSettings(steps=2400, train_side=480, sh_degree=1, max_splats=60_000),
    "standard": TrainSettings(
        train_side=800,
        sh_degree=2,
        max_splats=250_000,
        splats_per_view=7_000,
    ),
    "best": TrainSettings(steps_per_view=0, train_side=1600, sh_degree=3),
}

STAGE = Stage(
    "train",
    version=46,
    reads=("sfm", "seed"),
    settings_type=TrainSettings,
    **in_module("stages.train.stage"),
)
