"""Progress of the worker process, in a small file that its parent reads."""

from __future__ import annotations

import json
import os
import time
from pathlib import Path

_SECONDS = 0.2  # between two writes


def progress_path(database: Path) -> Path:
    """The file, beside the `database` that the step works on."""
    return database.with_name("progress.json")


class ProgressWriter:
    """Writes `progress_path`."""

    def __init__(self, database: Path) -> None:
        self._path = progress_path(database)
        self._next = 0.0

    def write(self, phase: str, done: int, total: int) -> None:
        """Record that `done` of `total` units of `phase` are finished; at most every 0.2 s, and
        always at the end."""
        now = time.monotonic()
        if now < self._next and done < total:
            return
        self._next = now + _SECONDS
        partial = self._path.with_name(self._path.name + ".partial")
        partial.write_text(json.dumps([phase, done, total]))
        os.replace(partial, self._path)


def read_progress(database: Path) -> tuple[str, int, int] | None:
    """(phase, done, total) as last written; None before the first time."""
    try:
        phase, done, total = json.loads(progress_path(database).read_text())
        return str(phase), int(done), int(total)
    except (OSError, ValueError, TypeError):
        return None
