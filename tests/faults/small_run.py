"""A run of a few photographs, and its stages one by one in forked processes that faults befall.

A fork needs no new imports: a stage then takes a second or two. The process that forks must never
have started threads, so this is used by `python -m tests.faults` and not by pytest itself.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib
import io
import os
import shutil
import sys
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests import sample

PHOTOS = 10  # of the sample capture, enough to be placed
FORMATS = ("ply", "gltf", "usdz", "sog", "html")
_MODULES = "modules"  # that the run has imported
CHECKPOINT_SECONDS = 0.2  # of training that lasts a second or two
_SETTINGS: dict[str, dict[str, Any]] = {
    "ingest": {"max_side": 500},
    "sfm": {"max_features": 2500},
    "train": {"steps": 150, "train_side": 100, "max_splats": 800, "sh_degree": 1},
    "prune": {"rounds": 2, "finetune_steps": 5},
    "quantise": {"rounding_steps": 3, "formats": FORMATS},
    "export": {"formats": FORMATS},
}


@dataclass(frozen=True)
class SmallRun:
    """A finished run in `folder`/run, made from `folder`/photos."""

    folder: Path

    @classmethod
    def made(cls, folder: Path) -> SmallRun:
        """Make it. Raises RuntimeError with the output if that fails."""
        photos = folder / "photos"
        photos.mkdir(parents=True)
        for photo in sorted(sample.PHOTOS.iterdir())[:PHOTOS]:
            shutil.copy(photo, photos)
        status, shown = forked(lambda: _whole(folder), folder / "log")
        if status:
            raise RuntimeError(shown)
        for name in (folder / _MODULES).read_text(encoding="utf-8").splitlines():
            with contextlib.suppress(Exception):  # parts that only their package can import
                importlib.import_module(name)
        return cls(folder)

    def before(self, stage: str, target: Path) -> None:
        """Make `target`/run, finished up to the stage before `stage`."""
        shutil.rmtree(target, ignore_errors=True)
        target.mkdir(parents=True, exist_ok=True)
        number = names().index(stage) + 1
        (target / "photos").symlink_to(self.folder / "photos")
        run = self.folder / "run"
        (target / "run").mkdir()
        shutil.copy(run / "run.json", target / "run")
        for earlier in sorted(run.glob("[1-7]-*"))[: number - 1]:
            shutil.copytree(earlier, target / "run" / earlier.name)

    def fault_of(self, stage: str, target: Path) -> str:
        """What is wrong with the finished `stage` in `target`/run: other bytes or left-overs."""
        (wanted,) = (self.folder / "run").glob(f"?-{stage}")
        found = target / "run" / wanted.name
        if outputs(found) != outputs(wanted):
            return "other bytes"
        left = [path.name for path in (target / "run").rglob(".*") if path.name != ".lock"]
        left += [path.name for path in (target / "run").rglob("*.tmp")]
        return f"left: {', '.join(left)}" if left else ""


def names() -> tuple[str, ...]:
    from stages.run.stages import STAGE_NAMES

    return tuple(STAGE_NAMES)


def outputs(folder: Path) -> dict[str, str]:
    """SHA-256 by name of each output file of a stage."""
    return {
        path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name != "manifest.json"
    }


def prepare() -> None:
    """Load what all processes need; the process has no threads afterwards."""
    import torch

    import stages.train.hooks
    from splatcli.app import app

    stages.train.hooks.CHECKPOINT_SECONDS = CHECKPOINT_SECONDS
    torch.set_num_threads(1)
    with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(SystemExit):
        app(["train", "--help"])


def stage_command(stage: str, folder: Path) -> None:
    """`splat STAGE run` in `folder`; of the first, with its photographs."""
    from splatcli.app import app

    os.chdir(folder)
    first = stage == names()[0]
    app([stage, "photos", "--out", "run", "--max-side", "500"] if first else [stage, "run"])


def forked(work: Callable[[], None], log: Path) -> tuple[int, str]:
    """`work` in a child process: (exit status, negative for a signal; what it printed)."""
    sys.stdout.flush()
    sys.stderr.flush()
    child = os.fork()
    if child == 0:
        from stages.base.parent import die_with_parent

        status = 1
        with contextlib.suppress(BaseException):
            die_with_parent(watch_input=False)
            output = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            for stream in (1, 2):
                os.dup2(output, stream)
            try:
                work()
                status = 0
            except SystemExit as end:
                status = int(end.code or 0)
            except BaseException:
                traceback.print_exc()
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(status)
    status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    return status, log.read_text(encoding="utf-8", errors="replace")


def _whole(folder: Path) -> None:
    from stages.base.stage import Stage
    from stages.run.pipeline import Pipeline

    os.chdir(folder)
    pipeline = Pipeline(Path("run"), Path("photos"))
    every: tuple[Stage, ...] = pipeline.layout.stages
    settings = {one.name: one.settings_type(**_SETTINGS.get(one.name, {})) for one in every}
    pipeline.run(settings)
    Path(_MODULES).write_text("\n".join(sorted(sys.modules)), encoding="utf-8")
