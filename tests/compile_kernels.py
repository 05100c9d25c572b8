"""`python -m tests.compile_kernels`: a small scene through all stages that compile, unless one was
before."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

from stages.export.settings import ExportSettings
from stages.prune.settings import PruneSettings
from stages.quantise.settings import QuantiseSettings
from stages.raster.kernels import cache
from stages.train.settings import TrainSettings


def main() -> None:
    if cache.are_compiled():
        return
    print("compiling kernels, once ...", flush=True)
    from stages.base.stage import Report
    from stages.export import stage as export
    from stages.mesh import fuse
    from stages.prune import stage as prune
    from stages.quantise import stage as quantise
    from stages.train import stage as train
    from tests.small_scene import small_scene

    fuse.VOXELS = 32**3  # what types are compiled counts, not sizes
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        scene = small_scene(folder)
        settings = TrainSettings(steps=150, train_side=72, max_splats=400, smooth=True)
        inputs: dict[str, Any] = {"sfm": scene.reconstruction, "seed": scene.splats}
        inputs["train"] = train.run(inputs, settings, folder, Report())
        inputs["prune"] = prune.run(inputs, PruneSettings(), folder, Report())
        inputs["quantise"] = quantise.run(inputs, QuantiseSettings(), folder, Report())
        export.run(inputs, ExportSettings(formats=("mesh",)), folder, Report())


if __name__ == "__main__":
    main()
