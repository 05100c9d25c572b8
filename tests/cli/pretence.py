"""Stages that only pretend to work."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any


def failing_at(name: str, error: Exception) -> Callable[..., None]:
    """Stage 1, which fails for the capture `name`."""

    def run(inputs: Any, settings: Any, folder: Path, report: Any) -> None:
        if inputs["photos"].name == name:
            raise error
        (folder / "out.ply").write_text("made")

    return run
