"""Kills without warning: before every new file name, rename and removal of every stage.

Python tells an audit hook of each before it happens. Names that libraries make are looked for by a
thread, and the process is killed as soon as one is there.
"""

from __future__ import annotations

import os
import re
import signal
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from tests.faults.small_run import SmallRun, forked, stage_command

_WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT
_EVENTS = ("os.mkdir", "os.rename", "os.remove", "os.rmdir", "shutil.rmtree", "os.symlink")
_CHANCE = re.compile(
    r"\.partial-[0-9a-f]+-\d+-([a-z0-9_]{8}(?=/|$))?"
)  # process id, random letters


@dataclass(frozen=True)
class Point:
    """Where to kill. event: the number of the event, from 0, or -1 for `name` that appears."""

    stage: str
    event: int
    name: str


def points(run: SmallRun, stage: str, folder: Path) -> list[Point]:
    """All points of a stage."""
    run.before(stage, folder)
    record = folder / "events"
    status, shown = forked(lambda: _record_events(stage, folder, record), folder / "log")
    if status:
        raise RuntimeError(shown)
    events = record.read_text(encoding="utf-8").splitlines()
    found = [Point(stage, i, name) for i, name in enumerate(events)]
    seen = sorted((folder / "seen").read_text(encoding="utf-8").splitlines())
    known = {name.partition(" ")[2] for name in events}
    appeared = (name for name in seen if name.startswith(".") and name not in known)
    return found + [Point(stage, -1, name) for name in appeared]


def killed(run: SmallRun, at: Point, again: Point | None, folder: Path) -> tuple[int, str]:
    """Kill a stage at a point, and its resumption at another one; then let it finish.

    Returns how many kills hit, and what is wrong afterwards ("" for nothing).
    """
    run.before(at.stage, folder)
    hits = 0
    for point in filter(None, (at, again)):
        status, shown = forked(partial(_to_be_killed, point, folder), folder / "log")
        if status not in (0, -signal.SIGKILL):
            return hits, f"status {status}: {shown[-500:]}"
        hits += status == -signal.SIGKILL
    status, shown = forked(lambda: stage_command(at.stage, folder), folder / "log")
    if status or "Traceback" in shown:
        return hits, f"not resumed, status {status}: {shown[-500:]}"
    return hits, run.fault_of(at.stage, folder)


def _record_events(stage: str, folder: Path, record: Path) -> None:
    """Run the stage and write its events to `record`, and the names that appeared to seen."""
    events: list[str] = []
    _watch_events(folder / "run", events.append)
    before, seen = set(_paths(folder / "run")), dict[str, None]()
    _every_millisecond(lambda: seen.update(dict.fromkeys(_paths(folder / "run"))))
    try:
        stage_command(stage, folder)
    finally:
        record.write_text("\n".join(events), encoding="utf-8")
        (folder / "seen").write_text("\n".join(set(seen) - before), encoding="utf-8")


def _to_be_killed(point: Point, folder: Path) -> None:
    count = 0

    def happens(event: str) -> None:
        nonlocal count
        if count == point.event:
            os.kill(os.getpid(), signal.SIGKILL)
        count += 1

    def look() -> None:
        if point.name in _paths(folder / "run"):
            os.kill(os.getpid(), signal.SIGKILL)

    if point.event >= 0:
        _watch_events(folder / "run", happens)
    else:
        _every_millisecond(look)
    stage_command(point.stage, folder)


def _watch_events(root: Path, happens: Callable[[str], object]) -> None:
    """Call `happens` before each change of a name below `root`, with the change."""
    inside = f"{root.resolve()}/"

    def hook(event: str, details: tuple[Any, ...]) -> None:
        if event == "open":
            path, _, flags = details
            if not isinstance(path, str) or not (flags or 0) & _WRITES:
                return
        elif event in _EVENTS:
            path = os.fspath(details[0])
        else:
            return
        where = os.path.abspath(path if isinstance(path, str) else os.fsdecode(path))
        if where.startswith(inside):
            happens(f"{event} {_plain(where.removeprefix(inside))}")

    sys.addaudithook(hook)


def _every_millisecond(look: Callable[[], object]) -> None:
    def watch() -> None:
        while True:
            look()
            time.sleep(0.001)

    threading.Thread(target=watch, daemon=True).start()


def _paths(root: Path) -> list[str]:
    return [
        _plain(os.path.relpath(os.path.join(place, name), root))
        for place, folders, files in os.walk(root)
        for name in (*folders, *files)
    ]


def _plain(name: str) -> str:
    """Without what differs between two runs."""
    return _CHANCE.sub(".partial-", name)
