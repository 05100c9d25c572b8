"""How far the worker process is, in a small file that its parent reads."""

from __future__ import annotations

import json
import os
import time
from pathlib import Path

_SECONDS = 0.2  # between two writings


class ProgressWriter:
    """Keeps the file at `path` up to date."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._next = 0.0

    def write(self, phase: str, done: int, total: int) -> None:
        """Say that `done` of `total` units of this phase are finished; seldom enough to cost
        nothing."""
        now = time.monotonic()
        if now < self._next and done < total:
            return
        self._next = now + _SECONDS
        partial = self._path.with_name(self._path.name + ".partial")
        partial.write_text(json.dumps([phase, done, total]))
        os.replace(partial, self._path)


def read_progress(path: Path) -> tuple[str, int, int] | None:
    """(phase, done, total) as last written; None before the first time."""
    try:
        phase, done, total = json.loads(path.read_text())
        return str(phase), int(done), int(total)
    except (OSError, ValueError, TypeError):
        return None
