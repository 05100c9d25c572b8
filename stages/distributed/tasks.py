"""A run, or a share of one, as a task: what is handed to whoever does it, here or elsewhere, and
what comes back.

Only paths and settings go out, only figures come back: everything else lies in run folders.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias

from stages.base.errors import CRASHED, Family, Interrupted, SplatError
from stages.run.failures import as_splat_error
from stages.run.pipeline import Listener, Pipeline

if TYPE_CHECKING:
    from stages.structure.chunks import Chunk


Location: TypeAlias = Path | str  # a path, or a URL


class Task(Protocol):
    """Something to do. folder: where what comes of it lies."""

    @property
    def folder(self) -> Path: ...

    def work(self, listener: Listener | None = None) -> None:
        """Do it, in this process; the listener hears of it. Raises what went wrong."""


@dataclass(frozen=True)
class RunTask:
    """What `splat process PHOTOS --out RUN_FOLDER` does; without photos, it goes on with the run
    folder. settings: by stage name, the recorded ones where left out. until: the last stage."""

    run_folder: Path
    photos: Path | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)
    until: str | None = None

    @property
    def folder(self) -> Path:
        return self.run_folder

    def work(self, listener: Listener | None = None) -> None:
        pipeline = Pipeline(self.run_folder, self.photos)
        pipeline.run(self.settings, until=self.until, listener=listener)


@dataclass(frozen=True)
class ChunkTask:
    """A share of features or matches."""

    share: Chunk

    @property
    def folder(self) -> Path:
        return self.share.out.parent

    def work(self, listener: Listener | None = None) -> None:
        from stages.structure.chunks import run_chunk

        run_chunk(self.share)


@dataclass(frozen=True)
class TaskResult:
    """How it went. status: exit status; code, said: of the error, "" if there was none."""

    status: int = 0
    code: str = ""
    said: str = ""


@dataclass(frozen=True)
class Resources:
    """What one task takes. memory_mib: None for all that one machine has."""

    memory_mib: float | None
    gpus: int = 0


def resources_of(train: Any) -> Resources:
    """What a run with these settings of training takes at most."""
    from stages.training.cap import needed_mib

    memory_mib = needed_mib(train.max_splats) if train.max_splats else None
    return Resources(memory_mib, gpus=int(train.backend == "gpu" or train.device == "cuda"))


class Executor(Protocol):
    """Brings tasks to their ends, one or several at a time."""

    def results(
        self, tasks: Sequence[Task], need: Resources, stop: Event | None = None
    ) -> Iterator[tuple[int, TaskResult]]:
        """(which task, how it ended), as they end. Raises SplatError, and Interrupted where `stop`
        is set, or a signal stopped what was being done at a safe place."""


OpenExecutor = Callable[[Path, Listener], AbstractContextManager[Executor]]
"""open_engine(folder, listener): what does the work in that folder."""


def run_task(task: Task, listener: Listener | None = None) -> TaskResult:
    """Do it, in this process. A failure is an ending; only Interrupted is raised."""
    try:
        task.work(listener)
    except Interrupted:
        raise
    except SplatError as error:
        return error_result(error)
    except Exception as error:
        known = as_splat_error(error, "the run", task.folder)
        return error_result(known or error)
    return TaskResult()


def run_all(
    engine: Executor,
    tasks: Sequence[Task],
    need: Resources,
    stop: Event,
    tick: Callable[[int], None],
    hint: str,
) -> None:
    """Bring all to their ends; tick: told how many have. Raises SplatError for the first that
    failed, once the others have ended, with this hint; and as `Engine.results`, and as `tick`."""
    failed = None
    for done, (number, ending) in enumerate(engine.results(tasks, need, stop), start=1):
        tick(done)
        if ending.status and failed is None:
            failed = SplatError(
                ending.code,
                given=f"In {tasks[number].folder}: {ending.said}",
                wanted="All of it done.",
                hint=hint,
                family=Family(max(ending.status, Family.USAGE)),
            )
    if failed is not None:
        raise failed


def error_result(error: Exception) -> TaskResult:
    """An error as figures and words."""
    if isinstance(error, SplatError):
        return TaskResult(int(error.family), error.code, error.given)
    said = str(error).splitlines()[0] if str(error) else "no more is known"
    return TaskResult(CRASHED, "bug", f"{type(error).__name__}: {said}.")


class SerialExecutor:
    """One task after the other, in this process."""

    def __init__(self, listener: Listener | None = None) -> None:
        self.listener = listener

    def results(
        self, tasks: Sequence[Task], need: Resources, stop: Event | None = None
    ) -> Iterator[tuple[int, TaskResult]]:
        for number, task in enumerate(tasks):
            if stop is not None and stop.is_set():
                raise Interrupted(f"before {task.folder}")
            yield number, run_task(task, self.listener)
