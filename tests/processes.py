"""Processes that tests start: the package that is installed, and an end whatever happens."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
PATIENCE_S = 60.0


def splat(*words: str) -> list[str]:
    """`splat WORDS` as a command line."""
    return [sys.executable, "-m", "splatcli", *words]


def python(code: str, *words: str) -> list[str]:
    """A command line that runs `code`; modules of the tests can be imported there too, after those
    that are installed."""
    return [sys.executable, "-c", f"import sys; sys.path.append({str(ROOT)!r})\n{code}", *words]


def module(name: str, *words: str) -> list[str]:
    """`python -m NAME WORDS` for a module of the tests."""
    run = f"import runpy; runpy.run_module({name!r}, run_name='__main__', alter_sys=True)"
    return python(run, *words)


@contextmanager
def running(command: Sequence[str], **how: Any) -> Iterator[subprocess.Popen[str]]:
    """A process that is killed on leaving if it still runs, its standard output a pipe of text.

    Popen's own context would wait for it, for ever where it ignores the signal that was sent.
    """
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, **how)
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def line_of(process: subprocess.Popen[str]) -> str:
    """The next line of its standard output."""
    assert process.stdout is not None
    return process.stdout.readline()
