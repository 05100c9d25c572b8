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


Place: TypeAlias = Path | str  # a path, or a URL


class Task(Protocol):
    """Something to do. folder: where what comes of it lies."""

    @property
    def folder(self) -> Path: ...

    def work(self, listener: Listener | None = None) -> None:
        """Do it, in this process; the listener hears of it. Raises what went wrong."""


@dataclass(frozen=True)
class Run:
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
class OfStructure:
    """A share of features or matches."""

    share: Chunk

    @property
    def folder(self) -> Path:
        return self.share.out.parent

    def work(self, listener: Listener | None = None) -> None:
        from stages.structure.chunks import run_chunk

        run_chunk(self.share)


@dataclass(frozen=True)
class Ending:
    """How it went. status: exit status; code, said: of the error, "" if there was none."""

    status: int = 0
    code: str = ""
    said: str = ""


@dataclass(frozen=True)
class Need:
    """What one task takes. memory_mib: None for all that one machine has."""

    memory_mib: float | None
    gpus: int = 0


def need_of(train: Any) -> Need:
    """What a run with these settings of training takes at most."""
    from stages.training.density import needed_mib

    memory_mib = needed_mib(train.max_splats) if train.max_splats else None
    return Need(memory_mib, gpus=int(train.backend == "gpu" or train.device == "cuda"))


class Engine(Protocol):
    """Brings tasks to their ends, one or several at a time."""

    def results(
        self, tasks: Sequence[Task], need: Need, stop: Event | None = None
    ) -> Iterator[tuple[int, Ending]]:
        """(which task, how it ended), as they end. Raises SplatError, and Interrupted where `stop`
        is set, or a signal stopped what was being done at a safe place."""


OpenEngine = Callable[[Path, Listener], AbstractContextManager[Engine]]
"""open_engine(folder, listener): what does the work in that folder."""


def work_on(task: Task, listener: Listener | None = None) -> Ending:
    """Do it, in this process. A failure is an ending; only Interrupted is raised."""
    try:
        task.work(listener)
    except Interrupted:
        raise
    except SplatError as error:
        return ending_of(error)
    except Exception as error:
        known = as_splat_error(error, "the run", task.folder)
        return ending_of(known or error)
    return Ending()


def do_all(
    engine: Engine,
    tasks: Sequence[Task],
    need: Need,
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


def ending_of(error: Exception) -> Ending:
    """An error as figures and words."""
    if isinstance(error, SplatError):
        return Ending(int(error.family), error.code, error.given)
    said = str(error).splitlines()[0] if str(error) else "no more is known"
    return Ending(CRASHED, "bug", f"{type(error).__name__}: {said}.")


class InTurn:
    """One task after the other, in this process."""

    def __init__(self, listener: Listener | None = None) -> None:
        self.listener = listener

    def results(
        self, tasks: Sequence[Task], need: Need, stop: Event | None = None
    ) -> Iterator[tuple[int, Ending]]:
        for number, task in enumerate(tasks):
            if stop is not None and stop.is_set():
                raise Interrupted(f"before {task.folder}")
            yield number, work_on(task, self.listener)
