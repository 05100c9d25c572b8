"""The folders of one stage in a run folder, and the renames that make its output final.

`4-train` holds finished output. `.4-train.partial` is the working folder; it is kept after an
interruption, and after a failure with the reason in it. `.4-train.old` is the previous output
between the two renames that replace it, and until the files in it that the stage did not write
have moved to the new output. After a crash at any point either the old or the new output is
complete, and files of others are in one of them.
"""

from __future__ import annotations

import json
import os
import shutil
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from stages.base.atomic import rename, sync_folder
from stages.base.errors import SplatError
from stages.base.stage import Stage
from stages.run.digests import damage
from stages.run.manifest import MANIFEST, Manifest, write_json
from stages.run.request import REQUEST, Request

USAGE = "usage.json"
_FAILURE = "failure.json"
_FILES = (MANIFEST, REQUEST, USAGE, _FAILURE)
KEPT = "kept"  # folder in an output, for files of others whose name the stage needs
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

    @property
    def _dropped(self) -> Path:
        return self.run_folder / f".{self.label}.dropped"

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
            rename(self.old, self.final)
            sync_folder(self.run_folder)
        self._drop_old()

    def files_of_others(self, old: Path, new: Path) -> dict[str, str]:
        """The files in the output `old` that the stage did not write, or that were changed since,
        and the name that each gets in the output `new`: its own if the stage has not written that
        name, and else one in the folder `KEPT`. Raises OSError."""
        try:
            manifest = Manifest.read(old)
        except SplatError:
            manifest = None
        outputs = manifest.outputs if manifest else {}
        new_names = {}
        for path in sorted(old.rglob("*")):
            name = path.relative_to(old).as_posix()
            if name in BOOKKEEPING or (path.is_dir() and not path.is_symlink()):
                continue
            if name not in outputs or damage(old, {name: outputs[name]}):
                own = manifest and name not in outputs and not os.path.lexists(new / name)
                new_names[name] = name if own else _free_name(new, f"{KEPT}/{name}")
        return new_names

    def _replace(self) -> None:
        for name in BOOKKEEPING - {MANIFEST}:
            (self.partial / name).unlink(missing_ok=True)
        if self.final.exists():
            self._drop_old()
            rename(self.final, self.old)
        rename(self.partial, self.final)
        sync_folder(self.run_folder)  # before the old output goes
        self._drop_old()

    def _drop_old(self) -> None:
        """Delete the previous output, and move files of others in it to the present one."""
        if self.old.exists():
            for name, kept in self.files_of_others(self.old, self.final).items():
                (self.final / kept).parent.mkdir(parents=True, exist_ok=True)
                rename(self.old / name, self.final / kept)
                sync_folder((self.final / kept).parent)
            if self._dropped.exists():
                shutil.rmtree(self._dropped)
            rename(self.old, self._dropped)  # half deleted, it would not tell what is whose
            sync_folder(self.run_folder)
        shutil.rmtree(self._dropped, ignore_errors=True)


def _free_name(folder: Path, name: str) -> str:
    """`name`, or one with a number before its suffix, that nothing in `folder` has."""
    path, number, free = Path(name), 1, name
    while os.path.lexists(folder / free):
        number += 1
        free = path.with_name(f"{path.stem}-{number}{path.suffix}").as_posix()
    return free


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
