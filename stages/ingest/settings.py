"""Settings of reading photographs. Imports neither NumPy nor torch."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from stages.base.settings import setting
from stages.base.stage import Stage, in_module


@dataclass(frozen=True)
class IngestSettings:
    """Settings of reading photographs."""

    max_side: int = setting(
        1600,
        "Longer side of the photographs used for structure from motion and, at most, "
        "for training (px).",
        panel="Quality and time",
        min=64,
        max=32_768,
    )
    masks: Path | None = setting(
        None,
        "Folder of masks, white where a photograph counts, named as the photographs "
        "are: a.png, a.jpg.png or a_mask.png for a.jpg. A folder called masks in or beside "
        "that of the photographs is found without this option.",
        panel="Light and masks",
        affects_output=False,  # its content does, which is an input
    )
    invert_masks: bool = setting(
        False, "Masks are black where a photograph counts, not white.", panel="Light and masks"
    )
    mask_means: str = setting(
        "auto",
        "How pixels outside a mask are treated: ignore (as unknown), transparent (as "
        "empty space) or auto (transparent for transparent pictures and for mask files that cut "
        "out an object, ignore for other mask files).",
        panel="Light and masks",
        choices=("auto", "ignore", "transparent"),
    )
    rig_mask: Path | None = setting(
        None,
        "Picture twice as wide as high, black where every 360-degree picture shows the camera's "
        "stand, the person who holds it, or a bad seam.",
        panel="Light and masks",
        affects_output=False,  # its content does, which is an input
    )
    depth: Path | None = setting(
        None,
        "Folder of measured depth maps, named as the photographs are, or a transforms.json that "
        "names them. A folder called depth in or beside that of the photographs is found without "
        "this option.",
        panel="Input",
        affects_output=False,  # its content does, which is an input
    )
    frames: int = setting(
        0,
        "Frames to take from each video, at most; 0 chooses by how far the camera moves.",
        panel="Input",
        min=0,
        max=100_000,
    )


STAGE = Stage(
    "ingest",
    version=20,
    reads=(),
    settings_type=IngestSettings,
    **in_module("stages.ingest.stage"),
)
