"""Where the work of a pipeline is done: in this process, or on a cluster."""

from __future__ import annotations

from contextlib import AbstractContextManager
from pathlib import Path

from stages.distributed import blocks, cluster
from stages.distributed.tasks import Executor
from stages.run.listener import Listener
from stages.run.pipeline import Pipeline


def distributed(pipeline: Pipeline, address: str | None = None) -> Pipeline:
    """The pipeline, which trains blocks on the cluster at `address`, or in this process without
    one."""

    def open_executor(folder: Path, listener: Listener) -> AbstractContextManager[Executor]:
        paths = filter(None, [pipeline.run_folder, pipeline.photos or pipeline.recorded_photos()])
        return cluster.open_executor(address, folder, paths, listener)

    return blocks.in_blocks(pipeline, open_executor)
