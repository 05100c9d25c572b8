"""The layers of packages: `test_layers` checks imports against them, `docs_tables` prints them."""

from __future__ import annotations

STAGE_FILES = ("ingest", "sfm", "seed", "train", "prune", "quantise", "export")

# Lowest first; a module may import from its own layer (but not in a circle) and from those above it
# in this list. Types that only a type checker reads may come from anywhere.
LAYERS: tuple[tuple[str, ...], ...] = (
    ("stages.base",),
    ("stages.scene",),
    ("stages.raster", "stages.formats", "stages.cameras", "stages.photos"),
    ("stages.measure", "stages.structure"),
    ("stages.training", "stages.editing", "stages.proof", "stages.surface", "stages.capacity"),
    ("stages", *(f"stages.{name}" for name in STAGE_FILES)),
    ("stages.run", "stages.api", "stages.viewer", "stages.distributed"),
    ("splatcli",),
)
