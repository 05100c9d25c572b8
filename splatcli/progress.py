"""Progress of a run: a bar on a terminal, lines elsewhere, events for machines."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from rich.console import RenderableType
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TextColumn,
    TimeRemainingColumn,
)
from rich.table import Column
from rich.text import Text

from splatcli import console
from stages.base.stage import Numbers, Stage
from stages.run.listener import Listener
from stages.run.manifest import Manifest, json_value

_LINE_EVERY_S = 10.0
_EVENT_EVERY_S = 0.5
_LABEL_WIDTH = 24
_COUNTED = ("photographs", "pairs")
STOPPING = "Stopping at the next safe place (Ctrl-C again stops at once)."


def listener_for(mode: console.Mode) -> Listener:
    """The listener that suits the options and the output."""
    if mode.as_json:
        return Events()
    if mode.quiet:
        return Quiet()
    return Bars() if console.err.is_terminal else Lines()


class Quiet(Listener):
    """Prints warnings, and the wait after Ctrl-C."""

    def finished(self, stage: Stage, number: int, manifest: Manifest) -> None:
        warn(manifest)

    def stopping(self) -> None:
        console.note(STOPPING)


def warn(manifest: Manifest) -> None:
    """Print a stage's warnings."""
    for code, sentence in manifest.warnings:
        console.warn(f"Warning ({manifest.stage}): {sentence} ({code})")


class Events(Listener):
    """One JSON object a line, on standard output."""

    def __init__(self) -> None:
        self._last = 0.0

    def started(self, stage: Stage, number: int, reason: str, resumed: bool) -> None:
        self._last = 0.0
        console.emit("started", stage=stage.name, reason=reason, resumed=resumed)

    def progressed(self, stage: Stage, label: str, done: int, total: int, numbers: Numbers) -> None:
        now = time.monotonic()
        if now - self._last >= _EVENT_EVERY_S or done >= total:
            self._last = now
            values: dict[str, Any] = {"label": label, "done": done, "total": total}
            console.emit("progress", stage=stage.name, **values, numbers=json_value(numbers))

    def finished(self, stage: Stage, number: int, manifest: Manifest) -> None:
        console.emit("finished", stage=stage.name, **result_of(manifest))

    def skipped(self, stage: Stage, number: int, manifest: Manifest) -> None:
        console.emit("skipped", stage=stage.name)

    def stopping(self) -> None:
        console.emit("stopping")


def result_of(manifest: Manifest) -> dict[str, Any]:
    """Costs, metrics and warnings of a finished stage as JSON data."""
    return {
        "seconds": manifest.seconds,
        "cpu_seconds": manifest.cpu_seconds,
        "peak_memory_mib": manifest.peak_memory_mib,
        "metrics": manifest.metrics,
        "warnings": manifest.warnings,
    }


class _PhaseTimer:
    """Rate and remaining time of one phase of a stage.

    A new phase begins when the count falls or the total changes, not when the label changes: it may
    name each photograph.
    """

    def __init__(self) -> None:
        self._start, self._first, self._done, self._total = 0.0, 0, 0, -1

    def new_phase(self, done: int, total: int) -> bool:
        """Record the count; True if it is the first of a phase."""
        new = total != self._total or done < self._done
        if new:
            self._start, self._first = time.monotonic(), done
        self._done, self._total = done, total
        return new

    def text(self) -> str:
        spent = time.monotonic() - self._start
        if self._done <= self._first or spent <= 0:
            return ""
        rate = (self._done - self._first) / spent
        return f"{_rate(rate)}, {console.duration((self._total - self._done) / rate)} left"


def _rate(per_second: float) -> str:
    return f"{per_second:.1f}/s" if per_second >= 1 else f"{1 / per_second:.1f} s each"


def _figures(numbers: Numbers) -> str:
    """The figures as text, without those that the count shows."""
    return console.figures({name: value for name, value in numbers.items() if name not in _COUNTED})


class Lines(Quiet):
    """A line every few seconds, for output that goes to a file."""

    def __init__(self) -> None:
        self._last = 0.0
        self._timer = _PhaseTimer()

    def started(self, stage: Stage, number: int, reason: str, resumed: bool) -> None:
        self._timer = _PhaseTimer()
        how = "goes on" if resumed else "runs"
        console.note(f"{number}/7 {stage.name}: {how} ({reason})")

    def progressed(self, stage: Stage, label: str, done: int, total: int, numbers: Numbers) -> None:
        now = time.monotonic()
        if not self._timer.new_phase(done, total) and now - self._last < _LINE_EVERY_S:
            return
        self._last = now
        parts = [f"{done}/{total}", self._timer.text(), _figures(numbers)]
        console.note(f"  {label or stage.name}: " + ", ".join(filter(None, parts)))

    def finished(self, stage: Stage, number: int, manifest: Manifest) -> None:
        console.note(f"{number}/7 {stage.name}: done in {console.duration(manifest.seconds)}")
        super().finished(stage, number, manifest)

    def skipped(self, stage: Stage, number: int, manifest: Manifest) -> None:
        console.note(f"{number}/7 {stage.name}: up to date")


class _Rate(ProgressColumn):
    """Units a second, or seconds a unit."""

    def render(self, task: Task) -> Text:
        speed = task.finished_speed or task.speed
        return Text(_rate(speed) if speed else "", style="dim")


class _TimeLeft(TimeRemainingColumn):
    """Nothing, not dashes, until the time left is known: after the second unit."""

    def render(self, task: Task) -> Text:
        return Text("") if task.time_remaining is None else super().render(task)


def _whole() -> Column:
    """A column that is never cut nor wrapped."""
    return Column(no_wrap=True)


class _Bar(Progress):
    """A bar on standard error as wide as the terminal, its figures in a line below: beside it they
    would leave no room for the count, the rate and the time left."""

    def __init__(self, *first: ProgressColumn, disable: bool = False) -> None:
        super().__init__(
            *first,
            BarColumn(bar_width=None, table_column=Column(ratio=1)),
            MofNCompleteColumn(table_column=_whole()),
            _Rate(table_column=_whole()),
            _TimeLeft(compact=True, table_column=_whole()),
            console=console.err,
            transient=True,
            disable=disable,
            expand=True,
        )

    def get_renderables(self) -> Iterator[RenderableType]:
        yield from super().get_renderables()
        for task in self.tasks:
            if figures := task.fields.get("figures"):
                yield Text(f"    {figures}", style="cyan", no_wrap=True, overflow="ellipsis")


class Bars(Quiet):
    """A bar for each stage, with rate, remaining time and figures."""

    def __init__(self) -> None:
        self._progress: Progress | None = None
        self._timer = _PhaseTimer()

    def started(self, stage: Stage, number: int, reason: str, resumed: bool) -> None:
        self._close()
        self._timer = _PhaseTimer()
        self._progress = _Bar(
            TextColumn(f"[bold]{number}/7 {stage.name:<8}[/bold]", table_column=_whole()),
            TextColumn(
                "{task.description}",
                markup=False,
                table_column=Column(no_wrap=True, overflow="ellipsis", max_width=_LABEL_WIDTH),
            ),
        )
        waiting = "going on" if resumed else "starting"
        self._task = self._progress.add_task(waiting, total=None, figures="")
        self._progress.start()

    def progressed(self, stage: Stage, label: str, done: int, total: int, numbers: Numbers) -> None:
        if self._progress is None:
            return
        if self._timer.new_phase(done, total):
            self._progress.reset(self._task, total=total, completed=done)
        self._progress.update(
            self._task,
            description=label,
            completed=done,
            total=total,
            figures=_figures(numbers),
        )

    def finished(self, stage: Stage, number: int, manifest: Manifest) -> None:
        self._close()
        line = f"{number}/7 {stage.name:<8} done in {console.duration(manifest.seconds)}"
        console.note(line, "green")
        super().finished(stage, number, manifest)

    def skipped(self, stage: Stage, number: int, manifest: Manifest) -> None:
        console.note(f"{number}/7 {stage.name:<8} up to date", "dim")

    def ended(self) -> None:
        self._close()

    def _close(self) -> None:
        if self._progress is not None:
            self._progress.stop()
            self._progress = None


@contextmanager
def counting(what: str, total: int) -> Iterator[Callable[[], None]]:
    """Yield a function to call after each of `total` items; shows the count, the rate and the
    remaining time. One item is not worth a count, but for machines."""
    done, last, timer, mode = 0, time.monotonic(), _PhaseTimer(), console.mode
    shown = mode.has_notes and total > 1
    bar = _Bar(TextColumn(what), disable=not (shown and console.err.is_terminal))
    task = bar.add_task(what, total=total)
    timer.new_phase(0, total)

    def tick() -> None:
        nonlocal done, last
        done += 1
        bar.advance(task)
        timer.new_phase(done, total)
        every = _EVENT_EVERY_S if mode.as_json else _LINE_EVERY_S
        if (done < total or not mode.as_json) and time.monotonic() - last < every:
            return
        last = time.monotonic()
        if mode.as_json:
            console.emit("progress", label=what, done=done, total=total)
        elif bar.disable and shown:
            console.note(f"{what}: {done}/{total}, {timer.text()}")

    with bar:
        yield tick
