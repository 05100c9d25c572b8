"""The log of `--verbose`: what a bug report needs, in a file of the system's temporary folder."""

from __future__ import annotations

import logging
import os
import platform
import shlex
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from stages.base import threads
from stages.base.distribution import NAME, VERSION
from stages.base.libraries import versions
from stages.base.memory import available_mib
from stages.base.stage import Numbers, Stage
from stages.run.listener import Listener
from stages.run.manifest import Manifest

_LOGGERS = tuple(map(logging.getLogger, ("splatcli", "stages", "py.warnings")))
_log = logging.getLogger(__name__)
_handler: logging.FileHandler | None = None


def hide_warnings() -> None:
    """Keep warnings of libraries, which are for programmers, from the terminal. A log has them."""
    logging.captureWarnings(True)


def start() -> Path | None:
    """Begin a log and write the machine and the versions to it; its path, None if no file can be
    written. A log that was begun before goes on."""
    global _handler
    if _handler is not None:
        return Path(_handler.baseFilename)
    try:
        descriptor, name = tempfile.mkstemp(prefix="splat-", suffix=".log")
        os.close(descriptor)
        _handler = logging.FileHandler(name, encoding="utf-8", errors="backslashreplace")
    except OSError:
        return None
    _handler.setFormatter(logging.Formatter("%(asctime)s %(name)s: %(message)s"))
    for logger in _LOGGERS:
        logger.addHandler(_handler)
        logger.setLevel(logging.DEBUG)
    for title, value in _environment().items():
        _log.debug("%s: %s", title, value)
    return Path(name)


def stop() -> None:
    """End the log, if there is one; warnings of libraries are printed again."""
    global _handler
    logging.captureWarnings(False)
    if _handler is None:
        return
    for logger in _LOGGERS:
        logger.removeHandler(_handler)
        logger.setLevel(logging.NOTSET)
    _handler.close()
    _handler = None


def write_failure(error: BaseException) -> None:
    """Write the traceback of `error` and of its causes, if there is a log."""
    _log.debug("%s", type(error).__name__, exc_info=error)


def write_settings(settings: Mapping[str, Any]) -> None:
    """Write the settings (dataclasses by stage name), if there is a log."""
    for name, value in settings.items():
        _log.debug("settings of %s: %s", name, vars(value))


def _environment() -> dict[str, str]:
    variables = {n: v for n, v in os.environ.items() if n.startswith(("SPLAT_", "OMP_", "NUMBA_"))}
    return {
        "command": shlex.join(sys.argv),
        "version": f"{NAME} {VERSION}, Python {platform.python_version()}",
        "platform": platform.platform(),
        "processor": f"{platform.machine()}, {os.cpu_count()} cores, {threads.count()} threads",
        "free memory": f"{available_mib():,.0f} MiB",
        "libraries": ", ".join(f"{name} {version}" for name, version in versions().items()),
        "variables": str(variables),
    }


class LogListener(Listener):
    """Writes the events of a run to the log, if there is one."""

    def __init__(self) -> None:
        self._label = ""

    def started(self, stage: Stage, number: int, reason: str, resumed: bool) -> None:
        _log.debug("%s: %s (%s)", stage.name, "resumed" if resumed else "started", reason)

    def progressed(self, stage: Stage, label: str, done: int, total: int, numbers: Numbers) -> None:
        if label != self._label or done >= total:
            self._label = label
            _log.debug("%s: %s %d/%d %s", stage.name, label, done, total, numbers)

    def finished(self, stage: Stage, number: int, manifest: Manifest) -> None:
        _log.debug("%s: finished in %.1f s", stage.name, manifest.seconds)
        _log.debug("%s: peak memory %.0f MiB", stage.name, manifest.peak_memory_mib)
        _log.debug("%s: metrics %s", stage.name, manifest.metrics)
        for code, sentence in manifest.warnings:
            _log.debug("%s: warning %s: %s", stage.name, code, sentence)

    def skipped(self, stage: Stage, number: int, manifest: Manifest) -> None:
        _log.debug("%s: up to date", stage.name)
