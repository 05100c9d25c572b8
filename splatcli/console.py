"""Errors, tables and figures as text for a terminal. Progress is in progress.py."""

from __future__ import annotations

import functools
import io
import json
import os
import re
import shlex
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import typer
from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment
from rich.table import Table
from rich.text import Text

from splatcli import log
from stages.base.errors import CRASHED, STOPPED, Interrupted, ResourceError, SplatError, UsageError
from stages.base.text import printable, printable_name
from stages.base.text import size as size
from stages.run.failures import as_splat_error


def take_any_output() -> None:
    """Characters that standard output cannot encode, as of paths on Windows, become escapes. Where
    it or standard error is closed, what is printed there is lost."""
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")


@contextmanager
def output_written() -> Iterator[None]:
    """Raise SplatError "output-not-written" where the system refuses what the block prints."""
    try:
        yield
    except BrokenPipeError:  # the reader has seen enough
        raise
    except OSError as error:
        raise output_lost(error) from error


def output_lost(error: OSError) -> SplatError:
    """The error for output that was refused. What is printed later on standard output is lost, so
    that the end of the process does not fail as well."""
    with suppress(OSError, ValueError):  # of a standard output that is no file
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return ResourceError(
        "output-not-written",
        given=f"What the command prints could not be written: {error.strerror or error}.",
        wanted="A standard output that takes it.",
        hint="Free some space where it goes, or print to another file.",
    )


class _Screen(Console):
    """Prints nothing that a terminal would act on except its own styles: names of files may hold
    escape sequences."""

    def render(
        self, renderable: RenderableType, options: ConsoleOptions | None = None
    ) -> Iterator[Segment]:
        for part in super().render(renderable, options):
            yield part if part.control else Segment(printable(part.text), part.style)

    def print(self, *objects: Any, **how: Any) -> None:
        with output_written():
            super().print(*objects, **how)


out = _Screen(highlight=False, soft_wrap=True)
err = _Screen(stderr=True, highlight=False, soft_wrap=True)

_URL = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+:/")  # a Windows drive has one letter
EXACT_DB = 99.0  # the PSNR that is recorded for equal pictures


@dataclass
class Mode:
    """How the command that runs prints: --quiet, and --json."""

    quiet: bool = False
    as_json: bool = False

    @property
    def has_notes(self) -> bool:
        """Whether lines for a reader are wanted."""
        return not self.quiet and not self.as_json


mode = Mode()  # of this process, which runs one command


def emit(event: str, **values: Any) -> None:
    """One line of JSON on standard output. Raises SplatError (output-not-written)."""
    with output_written():
        sys.stdout.write(json.dumps({"event": event, **values}) + "\n")
        sys.stdout.flush()


def _refuse_urls(values: Mapping[str, Any]) -> None:
    """Raise SplatError (url-not-local) for a path that was typed as a URL; `Path` keeps one slash
    of two."""
    for value in values.values():
        if isinstance(value, Path) and _URL.match(str(value)) and not value.exists():
            raise UsageError(
                "url-not-local",
                given=f"{str(value).replace(':/', '://', 1)} is a URL.",
                wanted="A file or folder of this machine.",
                hint="`splat batch` reads captures from URLs and writes runs to them: splat batch "
                "PHOTOS --out URL. Copy other files first.",
            )


def guarded(command: Callable[..., Any]) -> Callable[..., Any]:
    """A command whose failures are printed, with the exit status of their family."""

    @functools.wraps(command)
    def call(**values: Any) -> None:
        mode.quiet, mode.as_json = (values.pop(name, False) for name in ("quiet", "as_json"))
        log.hide_warnings()
        try:
            if values.pop("verbose", False):
                _start_log()
            _refuse_urls(values)
            command(**values)
        except SplatError as error:
            log.write_failure(error)
            raise typer.Exit(show_error(error)) from error
        except (Interrupted, KeyboardInterrupt) as stop:
            raise typer.Exit(show_stopped()) from stop
        except (typer.Exit, BrokenPipeError):
            raise
        except Exception as error:
            explained = as_splat_error(error, "the command", Path())
            if explained is not None:
                log.write_failure(error)
                raise typer.Exit(show_error(explained)) from error
            if os.environ.get("SPLAT_DEBUG") == "1":
                raise
            raise typer.Exit(show_bug(error)) from error
        finally:
            log.stop()

    return call


def _start_log() -> None:
    path = log.start()
    if mode.as_json:
        emit("log", path=str(path) if path else None)
    else:
        note(f"Log: {path}" if path else "No log can be written to the temporary folder.")


def show_error(error: SplatError) -> int:
    """Print an error; returns the exit status."""
    if mode.as_json and error.code != "output-not-written":
        with suppress(SplatError):  # it is printed below, for a reader
            emit("error", **error.as_dict())
            return int(error.family)
    paragraph(err, Text("Error: ", style="bold red") + Text(printable_name(error.given)))
    paragraph(err, Text("Wanted: ", style="bold") + Text(printable_name(error.wanted)))
    err.print(Text("Next: ", style="bold") + Text(printable_name(error.hint)))
    err.print(Text(f"({error.code}, exit status {int(error.family)})", style="dim"))
    return int(error.family)


def show_stopped() -> int:
    """Print how to go on after Ctrl-C; returns the exit status."""
    again = shlex.join(["splat", *sys.argv[1:]])
    if mode.as_json:
        emit("stopped", go_on=again)
    else:
        err.print("Stopped. What was finished is kept.")
        err.print(Text("Go on with: ", style="bold") + Text(again))
    return STOPPED


def show_bug(error: BaseException) -> int:
    """Print an unexpected failure and the log with its traceback; returns the exit status."""
    path = log.start()
    log.write_failure(error)
    what = f"{type(error).__name__}: {error}".splitlines()[0]
    if mode.as_json:
        emit("bug", message=what, log=str(path) if path else None)
        return CRASHED
    err.print(Text("Unexpected failure: ", style="bold red") + Text(what))
    err.print("This is a bug in splat. What was finished is kept.")
    if path:
        err.print(Text("Next: ", style="bold") + Text(f"report it with {path}"))
    return CRASHED


def table(headings: Sequence[str], rows: Iterable[Sequence[str]], title: str = "") -> None:
    """Print a table; columns of figures are aligned right."""
    rows = [list(map(str, row)) for row in rows]
    drawn = Table(title=title or None, title_justify="left", box=None, pad_edge=False)
    drawn.show_header = any(headings)
    for i, heading in enumerate(headings):
        figures = all(row[i][:1].isdigit() or row[i] in ("", "-") for row in rows)
        drawn.add_column(heading, justify="right" if figures and i else "left", overflow="fold")
    for row in rows:
        drawn.add_row(*map(Text, row))
    out.print(drawn, soft_wrap=False)


def columns(headings: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Print a table whose rows are never wrapped, so that paths can be copied from it."""
    every = [tuple(headings), *map(tuple, rows)]
    widths = [max(map(len, column)) for column in zip(*every, strict=True)]
    for number, row in enumerate(every):
        line = "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True))
        out.print(Text(line.rstrip(), style="" if number else "bold"))


def note(text: str, style: str = "") -> None:
    """One line for the reader, on standard error."""
    err.print(Text(text, style=style))


def warn(text: str) -> None:
    """One warning, on standard error."""
    paragraph(err, Text(text, style="yellow"))


def paragraph(screen: Console, text: Text) -> None:
    """Print a sentence or several. A terminal gets lines that end between words; a file gets one
    line."""
    screen.print(text, soft_wrap=not screen.is_terminal)


def step(label: str, **counts: int) -> None:
    """Say that a step of the command begins. counts: of an event."""
    if mode.as_json:
        emit("progress", label=label, **counts)
    elif not mode.quiet:
        note(label)


def note_compiling() -> None:
    """Explain the delay if the kernels are not compiled yet."""
    from stages.raster.kernels import cache  # importing it makes a folder

    if mode.has_notes and not cache.are_compiled():
        note("Compiling the kernels; this is done once and takes about half a minute.")


_UNITS = {"_bytes": " B", "_db": " dB", "_px": " px", "_s": " s", "_mib": " MB", "_deg": "°"}


def figures(numbers: Mapping[str, Any]) -> str:
    """ "psnr 27.1 dB, splats 36,700": names give the unit."""
    return ", ".join(f"{label(name)} {figure(name, value)}" for name, value in numbers.items())


def label(name: str) -> str:
    """A figure's name without its unit: "held_out_psnr_db" becomes "held out PSNR"."""
    for suffix in _UNITS:
        name = name.removesuffix(suffix)
    words = name.replace("_", " ").split()
    return " ".join(w.upper() if w in ("psnr", "ssim", "sh") else w for w in words)


def figure(name: str, value: Any) -> str:
    """A figure with its unit."""
    unit = next((u for suffix, u in _UNITS.items() if name.endswith(suffix)), "")
    if name == "verify_db":
        return fidelity(value)
    if isinstance(value, bool):
        return "yes" if value else "no"
    if name.endswith("_mib"):
        return size(value * 2**20)
    if name.endswith("_bytes"):
        return size(value)
    if isinstance(value, int):
        return f"{value:,}{unit}"
    if isinstance(value, float):
        return f"{value:.4g}{unit}" if abs(value) < 1e4 else f"{value:,.0f}{unit}"
    return f"{value}{unit}"


def fidelity(psnr_db: float) -> str:
    """PSNR between pictures: "41.3 dB"; "exact" for pictures that are equal."""
    return "exact" if psnr_db >= EXACT_DB else figure("psnr_db", psnr_db)


def times(seconds: float, cpu_seconds: float) -> str:
    """Wall time; with the CPU time of all cores if it differs by more than half, and 1 s."""
    if abs(cpu_seconds - seconds) <= max(seconds / 2, 1.0):
        return duration(seconds)
    return f"{duration(seconds)} ({duration(cpu_seconds)} CPU)"


def duration(seconds: float) -> str:
    """ "4.2 s", "3:05", "1:02:03"."""
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"
