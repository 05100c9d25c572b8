"""The folders of one stage in a run folder, and the renames that make its output final.

`4-train` holds finished output. `.4-train.partial` is the working folder; it is kept after an
interruption, and after a failure with the reason in it. `.4-train.old` is the previous output
between the two renames that replace it. After a crash at any point either the old or the new
output is complete.
"""

from __future__ import annotations

import json
import shutil
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from stages.base.atomic import sync_folder
from stages.base.stage import Stage
from stages.run.manifest import MANIFEST, Manifest, write_json
from stages.run.request import REQUEST, Request

USAGE = "usage.json"
_FAILURE = "failure.json"
_FILES = (MANIFEST, REQUEST, USAGE, _FAILURE)
BOOKKEEPING = frozenset([*_FILES, *(name + ".tmp" for name in _FILES)])


@dataclass(frozen=True)
class Workspace:
    """run_folder: the run's folder. label: "4-train"."""

    run_folder: Path
    label: str

    @property
    def final(self) -> Path:
        return self.run_folder / self.label

    @property
    def partial(self) -> Path:
        return self.run_folder / f".{self.label}.partial"

    @property
    def old(self) -> Path:
        return self.run_folder / f".{self.label}.old"

    def note_failure(self, code: str, given: str) -> None:
        """Record in the working folder why the attempt failed, if the disk allows it."""
        with suppress(OSError):
            write_json(self.partial / _FAILURE, {"code": code, "given": given})

    def failure(self) -> str:
        """Why the last attempt failed, with the error code; "" if it did not fail."""
        try:
            data = json.loads((self.partial / _FAILURE).read_text(encoding="utf-8"))
            return f"{data['given']} ({data['code']})"
        except (OSError, ValueError, LookupError, TypeError):
            return ""

    def begin(self, request: Request) -> bool:
        """Prepare the working folder. True if it holds work on the same request. Raises OSError."""
        if self.partial.exists():
            (self.partial / _FAILURE).unlink(missing_ok=True)
            if request.matches(self.partial):
                for half in list(self.partial.rglob(".partial-*")):  # a killed writer left these
                    if half.is_dir() and not half.is_symlink():
                        shutil.rmtree(half)
                    else:
                        half.unlink(missing_ok=True)  # it may lie in a folder just removed
                return True
            shutil.rmtree(self.partial)
        self.partial.mkdir()
        request.write(self.partial)
        return False

    def finish(self, manifest: Manifest) -> None:
        """Write the manifest and make the working folder the finished one. Raises OSError."""
        manifest.write(self.partial)
        self._replace()

    def recover(self) -> None:
        """Complete or undo a replacement that a crash interrupted. Raises OSError."""
        if (self.partial / MANIFEST).exists():
            self._replace()
        elif self.old.exists() and not self.final.exists():
            self.old.rename(self.final)
            sync_folder(self.run_folder)
        if self.old.exists():
            shutil.rmtree(self.old)

    def _replace(self) -> None:
        for name in BOOKKEEPING - {MANIFEST}:
            (self.partial / name).unlink(missing_ok=True)
        if self.final.exists():
            if self.old.exists():
                shutil.rmtree(self.old)
            self.final.rename(self.old)
        self.partial.rename(self.final)
        sync_folder(self.run_folder)  # before the old output goes
        if self.old.exists():
            shutil.rmtree(self.old, ignore_errors=True)


@dataclass(frozen=True)
class Layout:
    """The stages of a run folder, in order, and their folders."""

    run_folder: Path
    stages: tuple[Stage, ...]

    def stage(self, name: str) -> Stage:
        """The stage called `name`. Raises KeyError."""
        for stage in self.stages:
            if stage.name == name:
                return stage
        raise KeyError(name)

    def number(self, stage: Stage) -> int:
        """Counted from 1."""
        return self.stages.index(stage) + 1

    def workspace(self, stage: Stage) -> Workspace:
        return Workspace(self.run_folder, f"{self.number(stage)}-{stage.name}")

    def up_to(self, name: str | None) -> tuple[Stage, ...]:
        """The stages up to and including `name`; all of them for None."""
        return self.stages if name is None else self.stages[: self.number(self.stage(name))]
