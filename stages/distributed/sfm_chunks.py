"""Structure from motion with shares of its features and matching done by a cluster."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stages.base.stage import Report, Stage
from stages.distributed.tasks import ChunkTask, Executor, OpenExecutor, Resources, run_all
from stages.run.pipeline import Listener, Pipeline

if TYPE_CHECKING:
    from stages.structure.chunks import Chunk


def with_shares(pipeline: Pipeline, open_engine: OpenExecutor) -> Pipeline:
    """The pipeline, whose features and matches are found by what `open_engine` opens."""
    plain = pipeline.layout.stage("sfm")
    return pipeline.with_run("sfm", partial(_sfm, pipeline, plain, open_engine))


def _sfm(
    pipeline: Pipeline,
    plain: Stage,
    open_engine: OpenExecutor,
    inputs: Mapping[str, Any],
    settings: Any,
    folder: Path,
    report: Report,
) -> Any:
    if settings.cameras is not None:  # few pairs, of cameras of their own
        return plain.run(inputs, settings, folder, report)
    run: Callable[..., Any] = plain.run
    with open_engine(pipeline.run_folder, Listener()) as engine:
        return run(inputs, settings, folder, report, executor=partial(_hand_out, engine, report))


def _hand_out(
    engine: Executor, report: Report, shares: Sequence[Chunk], look: Callable[[], None]
) -> None:
    from stages.structure.chunks import CHUNK_MEMORY_MIB

    if not shares:
        return
    what = "finding features" if shares[0].photographs else "matching"

    def tick(done: int) -> None:
        report.progress(done, len(shares), f"{what} (shares)")
        look()

    run_all(
        engine,
        [ChunkTask(share) for share in shares],
        Resources(CHUNK_MEMORY_MIB),
        report.stop_requested,
        tick,
        hint="Give the same command again: shares that are finished are kept.",
    )
