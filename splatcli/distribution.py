"""Where the work of a pipeline is done: in this process, or on a cluster."""

from __future__ import annotations

from contextlib import AbstractContextManager
from pathlib import Path

from stages.distributed import blocks, cluster
from stages.distributed.tasks import Executor
from stages.run.listener import Listener
from stages.run.pipeline import Pipeline
from stages.train.settings import TrainSettings


def distributed(pipeline: Pipeline, address: str | None = None) -> Pipeline:
    """The pipeline, which trains blocks on the cluster at `address`, or in this process without
    one."""

    def open_executor(folder: Path, listener: Listener) -> AbstractContextManager[Executor]:
        paths = filter(None, [pipeline.run_folder, pipeline.photos or pipeline.recorded_photos()])
        return cluster.open_executor(address, folder, paths, listener)

    return blocks.in_blocks(pipeline, open_executor)


def check_blocks(settings: TrainSettings, address: str | None) -> None:
    """Raises SplatError, before the first stage, for what training in blocks would refuse.

    address: of the cluster; None for this process, and where training is finished.
    """
    if settings.blocks == "1":
        return
    if settings.blocks != "auto":  # it may be one block
        blocks.check_settings(settings)
    if address is not None:
        cluster.check_address(address)
