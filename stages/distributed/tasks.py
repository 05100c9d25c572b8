"""Tasks and executors: what is sent to a worker, and what comes back.

A task holds paths and settings, its result only figures. All data is in run folders.
"""

from __future__ import annotations

import logging
import math
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from pathlib import Path
from threading import Event
from typing import Any, Protocol

from stages.base.errors import CRASHED, Family, Interrupted, SplatError
from stages.base.text import reason_of
from stages.distributed.remote import Location, local_copies
from stages.run.failures import as_splat_error
from stages.run.listener import Listener, Listeners
from stages.run.pipeline import Pipeline
from stages.run.stages import SHARED_OPTIONS
from stages.train.cap import needed_mib
from stages.train.settings import TrainSettings

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class RunTask:
    """`splat process PHOTOS --out RUN_FOLDER`.

    run_folder, photos: what is at a URL is copied to this machine first, see `remote.local_copies`.
    photos: None to continue the run folder. settings: by stage name; stages that are left out use
    the recorded ones. until: the last stage.
    """

    run_folder: Location
    photos: Location | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)
    until: str | None = None

    @property
    def folder(self) -> Path:
        is_url = isinstance(self.run_folder, str)
        return Path(tempfile.gettempdir()) if is_url else Path(self.run_folder)

    def run(self, listener: Listener | None = None, stop: Event | None = None) -> None:
        with local_copies(self.run_folder, self.photos) as (run_folder, photos, upload):
            listeners = Listeners(upload, listener or Listener())
            pipeline = Pipeline(run_folder, photos)
            formats = {  # files that were exported stay
                name: replace(given, formats=pipeline.with_exported(given.formats))
                for name, given in self.settings.items()
                if name in SHARED_OPTIONS["formats"]
            }
            settings = {**self.settings, **formats}
            pipeline.run(settings, until=self.until, listener=listeners, stop=stop)


def task_for(run_folder: Location, photos: Location, settings: Mapping[str, Any]) -> RunTask:
    """The task of one run, with absolute paths."""
    run_folder, photos = (
        location.absolute() if isinstance(location, Path) else location
        for location in (run_folder, photos)
    )
    return RunTask(run_folder, photos, settings)


@dataclass(frozen=True)
class TaskResult:
    """How a task ended. status: exit status. code, message: of the error; "" if there was none."""

    status: int = 0
    code: str = ""
    message: str = ""


@dataclass(frozen=True)
class Resources:
    """What one task needs. memory_mib: None for all the memory of a machine."""

    memory_mib: float | None
    gpus: int = 0


def resources_of(*trains: TrainSettings) -> Resources:
    """The largest resources that runs with these training settings need, each by itself."""
    most = max(train.max_splats or math.inf for train in trains)
    memory_mib = needed_mib(int(most)) if math.isfinite(most) else None
    return Resources(memory_mib, gpus=int(any(train.backend == "gpu" for train in trains)))


class Executor(Protocol):
    """Executes tasks, one or several at a time."""

    def results(
        self, tasks: Sequence[RunTask], need: Resources, stop: Event | None = None
    ) -> Iterator[tuple[int, TaskResult]]:
        """Yield (number of the task, its result) in the order in which tasks end.

        Raises SplatError, and Interrupted if `stop` is set or a signal stopped a task.
        """


OpenExecutor = Callable[[Path, Listener], AbstractContextManager[Executor]]
"""open_executor(folder, listener): an executor for tasks in that folder."""


def run_task(
    task: RunTask, listener: Listener | None = None, stop: Event | None = None
) -> TaskResult:
    """Run a task in this process, until `stop` is set or, without it, a signal comes. A failure
    becomes a result; only Interrupted is raised."""
    try:
        task.run(listener, stop)
    except Interrupted:
        raise
    except Exception as error:
        _log.debug("%s failed", task.folder, exc_info=error)
        if isinstance(error, SplatError):
            return error_result(error)
        return error_result(as_splat_error(error, "the run", task.folder) or error)
    return TaskResult()


def run_all(
    executor: Executor,
    tasks: Sequence[RunTask],
    need: Resources,
    stop: Event,
    progress: Callable[[int], None],
    hint: str,
) -> None:
    """Run all tasks.

    Args:
        progress: called with the number of tasks that have ended.
        hint: of the error that is raised for the first failed task, after all others have ended.

    Raises SplatError, and what `Executor.results` and `progress` raise.
    """
    failed = None
    for done, (number, result) in enumerate(executor.results(tasks, need, stop), start=1):
        progress(done)
        if result.status and failed is None:
            failed = SplatError(
                result.code,
                given=f"In {tasks[number].folder}: {result.message}",
                wanted="All tasks finished.",
                hint=hint,
                family=Family(max(result.status, Family.USAGE)),
            )
    if failed is not None:
        raise failed


def error_result(error: BaseException) -> TaskResult:
    """The result of a task that raised `error`."""
    if isinstance(error, SplatError):
        return TaskResult(int(error.family), error.code, error.given)
    return TaskResult(CRASHED, "bug", f"{type(error).__name__}: {reason_of(error)}.")


@dataclass(frozen=True)
class SerialExecutor:
    """Executes tasks one after another in this process."""

    listener: Listener | None = None

    def results(
        self, tasks: Sequence[RunTask], need: Resources, stop: Event | None = None
    ) -> Iterator[tuple[int, TaskResult]]:
        for number, task in enumerate(tasks):
            if stop is not None and stop.is_set():
                raise Interrupted(f"before {task.folder}")
            yield number, run_task(task, self.listener, stop)
