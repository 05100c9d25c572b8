"""Which steps from line to line of `stages` have been taken: what guides the inputs.

`sys.settrace` needs no instrumented build, and its cost is small where arrays do the work.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

import stages

_TRACED = str(Path(stages.__file__).parent)


class Arcs:
    """The (code, line before, line) seen so far."""

    def __init__(self) -> None:
        self._seen: set[tuple[CodeType, int, int]] = set()

    def __len__(self) -> int:
        return len(self._seen)

    @contextmanager
    def watching(self) -> Iterator[None]:
        sys.settrace(self._enter)
        try:
            yield
        finally:
            sys.settrace(None)

    def _enter(self, frame: FrameType, event: str, _: Any) -> Any:
        code = frame.f_code
        if not code.co_filename.startswith(_TRACED):
            return None
        before, seen = 0, self._seen

        def step(frame: FrameType, event: str, _: Any) -> Any:
            nonlocal before
            if event == "line":
                seen.add((code, before, frame.f_lineno))
                before = frame.f_lineno
            return step

        return step
