"""The types that stages meet in, and the conventions, stated once.

World: right-handed, y down (up = -Y), as in COLMAP and in the .ply files that viewers read;
recentred in float64. Camera: x right, y down, z forward; pixel centres at +0.5. Colour =
max(0, 0.5 + SH), in the photographs' own sRGB values. Images: [H, W, 3] float32 in [0, 1].

In reading order: `capture` (photographs and what is found from them), `camera`, `splats`,
`draw_settings` (how splats are drawn), `assets`, `mesh`, `place` (on the earth); on disk, `storage`
and `pictures`; and what works on these types: `rotations`, `light`, `framing`, `quantiles`,
`morton`, `recentring`, `flip`.
"""

from stages.scene.assets import ExportedAssets, ExportedFile
from stages.scene.camera import Camera, fitted_size, look_at
from stages.scene.capture import (
    IGNORE,
    TRANSPARENT,
    Capture,
    Face,
    Photo,
    Reconstruction,
    RefinedCameras,
    View,
    evenly_spaced,
    scene_extent,
    split_held_out,
    training_extent,
    why_none_is_held_out,
)
from stages.scene.draw_settings import DrawSettings, draw_settings_of
from stages.scene.splats import (
    ROW_FIELDS,
    SH_C0,
    PrunedSplats,
    QuantisedSplats,
    SizeLimit,
    Splats,
    TrainedSplats,
    dc_to_rgb,
    logit,
    parameters_per_splat,
    rgb_to_dc,
)
from stages.scene.storage import load_splats, save_splats

__all__ = [
    "IGNORE",
    "ROW_FIELDS",
    "SH_C0",
    "TRANSPARENT",
    "Camera",
    "Capture",
    "DrawSettings",
    "ExportedAssets",
    "ExportedFile",
    "Face",
    "Photo",
    "PrunedSplats",
    "QuantisedSplats",
    "Reconstruction",
    "RefinedCameras",
    "SizeLimit",
    "Splats",
    "TrainedSplats",
    "View",
    "dc_to_rgb",
    "draw_settings_of",
    "evenly_spaced",
    "fitted_size",
    "load_splats",
    "logit",
    "look_at",
    "parameters_per_splat",
    "rgb_to_dc",
    "save_splats",
    "scene_extent",
    "split_held_out",
    "training_extent",
    "why_none_is_held_out",
]
