"""`run.json`: the photographs of a run folder, and the settings last requested.

A folder with this file is a run folder. `splat train` continues with the settings in it, and
`splat status` tells from it what would run again. If the file is lost, the stages' folders still
identify the run folder; photographs and options have to be given again.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from stages.base.stage import Stage
from stages.run.manifest import MANIFEST, edited, read_sealed, write_sealed
from stages.run.request import REQUEST, settings_from_data, settings_to_data

RUN_FILE = "run.json"


@dataclass(frozen=True)
class RunFile:
    """photographs: absolute path. settings: JSON data by stage name."""

    photographs: Path | None = None
    settings: dict[str, dict[str, Any]] = field(default_factory=dict)

    @classmethod
    def read(cls, folder: Path) -> RunFile | None:
        """The folder's `run.json`: empty if it is missing beside folders of stages, None if there
        are none either. Raises SplatError as `read_sealed` does."""
        data = read_sealed(folder / RUN_FILE)
        if data is None:
            return cls() if holds_stages(folder) else None
        photographs, settings = data.get("photographs"), data.get("settings", {})
        if not isinstance(photographs, str | None) or not isinstance(settings, dict):
            raise edited(folder / RUN_FILE)
        return cls(Path(photographs) if photographs else None, settings)

    def write(self, folder: Path) -> None:
        """Write it atomically. Raises OSError."""
        photographs = str(self.photographs) if self.photographs else None
        write_sealed(folder / RUN_FILE, {"photographs": photographs, "settings": self.settings})

    def updated(self, settings: Mapping[str, Any]) -> RunFile:
        """With the settings (dataclasses by stage name) of some stages replaced."""
        changed = {name: settings_to_data(value) for name, value in settings.items()}
        return RunFile(self.photographs, {**self.settings, **changed})

    def with_settings_from(self, other: RunFile, stages: Collection[str]) -> RunFile:
        """With the settings of some stages as `other` has them."""
        kept = {name: value for name, value in self.settings.items() if name not in stages}
        back = {name: value for name, value in other.settings.items() if name in stages}
        return RunFile(self.photographs, kept | back)

    def settings_of(
        self, stages: Sequence[Stage], otherwise: Mapping[str, Any] | None = None
    ) -> dict[str, Any]:
        """Settings dataclasses of all stages: as recorded, else those in `otherwise`, else the
        defaults of the stage."""
        settings = dict(otherwise or {})
        for stage in stages:
            recorded = self.settings.get(stage.name, {})
            if recorded or stage.name not in settings:
                settings[stage.name] = settings_from_data(stage.settings_type, recorded)
        return settings


def holds_stages(folder: Path) -> bool:
    """Whether the folder holds a finished or unfinished stage of any version of splat."""
    return any(_is_of_stage(name, path) for name, path in _stage_files(folder))


def stage_folder_around(place: Path) -> Path | None:
    """The folder of a stage that `place` is or lies in."""
    place = place.resolve()
    for folder in (place, *place.parents):
        beside = _stage_files(folder.parent)
        if any(p.parent == folder and _is_of_stage(n, p) for n, p in beside):
            return folder
    return None


def _stage_files(folder: Path) -> Iterator[tuple[str, Path]]:
    """(stage name, manifest or request), manifests first."""
    for pattern in (f"[1-9]-*/{MANIFEST}", f".[1-9]-*.partial/{REQUEST}"):
        for path in sorted(folder.glob(pattern)):
            yield path.parent.name.removeprefix(".").removesuffix(".partial")[2:], path


def _is_of_stage(name: str, path: Path) -> bool:
    """Whether a file is the manifest or request of the stage `name`."""
    with suppress(OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError):
        data = json.loads(path.read_text(encoding="utf-8"))
        return bool(data.get("stage", name) == name and {"version", "inputs"} <= data.keys())
    return False
