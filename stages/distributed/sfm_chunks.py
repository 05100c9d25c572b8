"""Structure from motion whose features and matches are computed in chunks by an executor."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from stages.base.stage import Report
from stages.distributed.tasks import ChunkTask, Executor, OpenExecutor, Resources, run_all
from stages.run.listener import Listener
from stages.run.pipeline import Pipeline
from stages.sfm.settings import SfmSettings
from stages.sfm.worker.chunks import CHUNK_MEMORY_MIB, Chunk


def with_chunks(pipeline: Pipeline, open_executor: OpenExecutor) -> Pipeline:
    """The pipeline with the stage `sfm` in chunks."""
    run: Callable[..., Any] = pipeline.layout.stage("sfm").run

    def sfm(inputs: Mapping[str, Any], settings: SfmSettings, folder: Path, report: Report) -> Any:
        if settings.cameras is not None:  # known cameras have few pairs to match
            return run(inputs, settings, folder, report)
        with open_executor(pipeline.run_folder, Listener()) as executor:
            execute = partial(_execute, executor, report)
            return run(inputs, settings, folder, report, executor=execute)

    return pipeline.with_run("sfm", sfm)


def _execute(
    executor: Executor, report: Report, chunks: Sequence[Chunk], check: Callable[[], None]
) -> None:
    """See `sfm.worker.chunks.ChunkExecutor`."""
    if not chunks:
        return
    label = "extracting features" if chunks[0].photographs else "matching"

    def progress(done: int) -> None:
        report.progress(done, len(chunks), f"{label} (chunks)")
        check()

    run_all(
        executor,
        [ChunkTask(chunk) for chunk in chunks],
        Resources(CHUNK_MEMORY_MIB),
        report.stop_requested,
        progress,
        hint="Give the same command again: finished chunks are kept.",
    )
