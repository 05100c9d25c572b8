"""One attempt at one stage: run it in its working folder, measure it, make its output final."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from threading import Event
from typing import Any

from stages.base.errors import Interrupted
from stages.base.libraries import versions
from stages.base.memory import PeakMemory
from stages.base.stage import Report
from stages.base.text import reason_of
from stages.run.digests import combined_digest, record_files
from stages.run.failures import as_splat_error
from stages.run.listener import Listener
from stages.run.manifest import Manifest, json_value, write_json
from stages.run.request import Request, earlier_of
from stages.run.workspace import BOOKKEEPING, USAGE, Workspace

_NOTE_EVERY_S = 5.0


def attempt(
    request: Request,
    settings: Any,
    inputs: Mapping[str, Any],
    space: Workspace,
    stop: Event,
    listener: Listener,
) -> Manifest:
    """Run the stage of `request` in `space.partial`, which `Workspace.begin` prepared, and make its
    output final. settings: as the stage takes them; a limit of time may be shorter than requested.

    Raises Interrupted (the working folder is kept), SplatError for an error of the operating
    system, and whatever else the stage raises.
    """
    stage = request.stage
    done = Manifest.read(space.final)
    report = Report(stop_requested=stop, earlier=earlier_of(request, done, space.final))
    report.listener = lambda label, done, total, numbers: listener.progressed(
        stage, label, done, total, numbers
    )
    report.preview = lambda draw: listener.drawable(stage, draw)
    usage = _Usage(space.partial)
    try:
        with PeakMemory(tick=usage.note) as memory:
            stage.run(inputs, settings, space.partial, report)
    except Interrupted:
        raise
    except Exception as error:
        explained = as_splat_error(error, stage.name, space.run_folder)
        if explained is None:
            space.note_failure("bug", f"{type(error).__name__}: {reason_of(error)}.")
            raise
        space.note_failure(explained.code, explained.given)
        if explained is error:
            raise
        raise explained from error
    finally:
        usage.note(memory.peak_mib, now=True)
    for name, kept in space.files_of_others(space.final, space.partial).items():
        if name != kept:
            report.warn(
                "run-file-kept",
                f"{space.label}/{name} is not what splat wrote under that name. It was moved to "
                f"{space.label}/{kept}.",
            )
    manifest = _manifest(request, report, space.partial, usage)
    space.finish(manifest)
    return manifest


def _manifest(request: Request, report: Report, folder: Path, usage: _Usage) -> Manifest:
    outputs = record_files(folder, leave_out=BOOKKEEPING)
    return Manifest(
        stage=request.stage.name,
        version=request.stage.version,
        settings=request.settings,
        inputs=request.inputs,
        input_files=request.input_files,
        outputs=outputs,
        output_digest=combined_digest(outputs),
        seconds=round(usage.seconds, 3),
        cpu_seconds=round(usage.cpu_seconds, 3),
        peak_memory_mib=round(usage.peak_mib, 1),
        device=report.device,
        seed=request.settings.get("seed"),
        libraries=versions(),
        metrics=json_value(report.metrics),
        warnings=[list(pair) for pair in report.warnings],
    )


class _Usage:
    """Wall-clock seconds, CPU seconds and peak memory of all attempts together. They are saved in
    the working folder now and then, so that a run that is killed and resumed counts them all."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._noted = time.monotonic()
        self._start, self._cpu_start = self._noted, _cpu_seconds()
        self.peak_mib = 0.0
        with suppress(OSError, ValueError, KeyError, TypeError):
            before = json.loads((folder / USAGE).read_text(encoding="utf-8"))
            self.peak_mib = float(before["peak_memory_mib"])
            self._start -= float(before["seconds"])
            self._cpu_start -= float(before["cpu_seconds"])

    @property
    def seconds(self) -> float:
        return time.monotonic() - self._start

    @property
    def cpu_seconds(self) -> float:
        return _cpu_seconds() - self._cpu_start

    def note(self, peak_mib: float, now: bool = False) -> None:
        self.peak_mib = max(self.peak_mib, peak_mib)
        if now or time.monotonic() - self._noted >= _NOTE_EVERY_S:
            self._noted = time.monotonic()
            usage = {
                "seconds": self.seconds,
                "cpu_seconds": self.cpu_seconds,
                "peak_memory_mib": self.peak_mib,
            }
            with suppress(OSError):  # a full disk must not stop the work here
                write_json(self._folder / USAGE, usage)


def _cpu_seconds() -> float:
    """User and system time of this process and of its child processes that have ended."""
    return sum(os.times()[:4])
