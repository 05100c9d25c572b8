"""The interface of a stage, and the report that it fills while it runs.

A stage knows nothing of manifests, skipping or the terminal. Tests call `stage.run` with a
`Report` and a folder of their own.
"""

from __future__ import annotations

import importlib
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from stages.scene import Camera

Numbers = dict[str, float | int | str]
DrawView: TypeAlias = "Callable[[Camera], NDArray[np.uint8]]"


@dataclass(frozen=True)
class Earlier:
    """The output that a run of a stage replaces, where the same version made it with equal settings
    except `Stage.adds`. What does not depend on that setting, nor on an input that changed, may be
    taken from it.

    Args:
        folder: whose files are as they were written.
        settings: as plain data.
        metrics, warnings: as reported then.
        same_inputs: names of the inputs that have not changed.
        outputs: relative paths of the files that the stage wrote; others may lie beside them.
    """

    folder: Path
    settings: Mapping[str, Any]
    metrics: Mapping[str, Any]
    warnings: Sequence[Sequence[str]]
    same_inputs: frozenset[str]
    outputs: frozenset[str] = frozenset()


@dataclass
class Report:
    """Collects metrics, warnings and progress of one run of a stage.

    Attributes:
        metrics: JSON values, written to the manifest.
        warnings: (code, message) pairs; the message is a full sentence with advice.
        listener: called with each progress report.
        stop_requested: set from outside (Ctrl-C). Long stages check it at each step boundary,
            write their checkpoint and raise `Interrupted`.
        preview: called with the function given to `offer`; it must not change the output.
        device: hardware that the stage ran on, for the manifest.
        earlier: what may be taken from the output before, if anything.
    """

    metrics: dict[str, Any] = field(default_factory=dict)
    warnings: list[tuple[str, str]] = field(default_factory=list)
    listener: Callable[[str, int, int, Numbers], None] | None = None
    stop_requested: threading.Event = field(default_factory=threading.Event)
    preview: Callable[[DrawView], None] | None = None
    device: str = "cpu"
    earlier: Earlier | None = None

    def metric(self, name: str, value: Any) -> None:
        """Record one figure, JSON-serialisable, with the unit in its name (`psnr_db`)."""
        self.metrics[name] = value

    def warn(self, code: str, message: str) -> None:
        """Record one warning; equal pairs are kept once."""
        if (code, message) not in self.warnings:
            self.warnings.append((code, message))

    def progress(
        self, done: int, total: int, label: str = "", **numbers: float | int | str
    ) -> None:
        """Report that `done` of `total` units are finished, with numbers to show beside it."""
        if self.listener is not None:
            self.listener(label, done, total, numbers)

    def offer(self, draw: DrawView) -> None:
        """Offer a live preview: draw(camera) gives sRGB [H, W, 3] of the work so far. It may be
        called by this thread only, and until this method returns."""
        if self.preview is not None:
            self.preview(draw)


Run: TypeAlias = Callable[[Mapping[str, Any], Any, Path, Report], Any]
Load: TypeAlias = Callable[[Path], Any]


@dataclass(frozen=True)
class Stage:
    """The description of one stage of the pipeline.

    name: also the name of its command and the end of its folder's name.
    version: raised when equal inputs and settings give different bytes.
    reads: names of the earlier stages whose outputs `run` receives.
    settings_type: one flat frozen dataclass, torch-free; each field is a `settings.setting` with a
        default and a help that names the unit. Fields with `affects_output=False` (number of
        threads, say) do not make a stage run again.
    run(inputs, settings, folder, report): writes everything under `folder` and returns the output.
        `folder` may hold what an interrupted run of the same inputs and settings left there.
    load(folder): the output again, from a finished folder. Cheap: arrays may be loaded, images not.
    adds: a setting on which little depends, or whose items are made apart from each other: `run`
        may take the rest, or the items, from `Report.earlier`, if its own output has the same
        bytes.
    """

    name: str
    version: int
    reads: tuple[str, ...]
    settings_type: type
    run: Run
    load: Load
    adds: str = ""


def in_module(module: str) -> dict[str, Any]:
    """The arguments `run` and `load` of a `Stage`: functions of a module that is imported when one
    of them is called. Help, planning and status must not wait for NumPy and torch."""

    def run(*given: Any) -> Any:
        return importlib.import_module(module).run(*given)

    def load(folder: Path) -> Any:
        return importlib.import_module(module).load(folder)

    return {"run": run, "load": load}
