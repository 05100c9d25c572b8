"""The pipeline: from photographs to an asset, in seven stages."""

# zlib first: pycolmap's bundled copy corrupts the heap when Python's own is loaded after it.
import importlib
import zlib  # noqa: F401

from stages.base.stage import Stage
from stages.base.threads import configure

configure()

STAGE_NAMES = ("ingest", "sfm", "seed", "train", "prune", "quantise", "export")


def load_stage(name: str) -> Stage:
    """The `Stage` called `name`, imported at the call: `splat --help` must not wait for torch.

    Raises KeyError for an unknown name.
    """
    if name not in STAGE_NAMES:
        raise KeyError(name)
    stage: Stage = importlib.import_module(f"stages.{name}.stage").STAGE
    return stage
