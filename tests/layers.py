"""The layers of packages: `test_layers` checks imports against them, `docs_tables` prints them."""

from __future__ import annotations

STAGES = ("ingest", "sfm", "seed", "train", "prune", "quantise", "export")

# Lowest first; a module may import from its own layer (but not in a circle) and from those above it
# in this list.
LAYERS: tuple[tuple[str, ...], ...] = (
    ("stages.base", "stages"),
    ("stages.scene",),
    ("stages.raster", "stages.formats", "stages.cameras", "stages.page"),
    ("stages.evaluate",),
    ("stages.ingest",),
    ("stages.sfm",),
    ("stages.seed",),
    ("stages.train",),
    ("stages.prune",),
    ("stages.quantise",),
    ("stages.proof", "stages.mesh"),
    ("stages.export",),
    ("stages.tradeoff", "stages.editing", "stages.viewer", "stages.run"),
    ("stages.distributed",),
    ("splatcli",),
)
