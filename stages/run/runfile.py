"""`run.json`: the photographs of a run folder, and the settings last requested.

A folder with this file is a run folder. `splat train` continues with the settings in it, and
`splat status` tells from it what would run again.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from stages.base.stage import Stage
from stages.run.manifest import read_sealed, write_sealed
from stages.run.request import settings_from_data, settings_to_data

RUN_FILE = "run.json"


@dataclass(frozen=True)
class RunFile:
    """photographs: absolute path. settings: plain data by stage name."""

    photographs: Path | None = None
    settings: dict[str, dict[str, Any]] = field(default_factory=dict)

    @classmethod
    def read(cls, folder: Path) -> RunFile | None:
        """The folder's `run.json`, or None. Raises SplatError (see `read_sealed`)."""
        data = read_sealed(folder / RUN_FILE)
        if data is None:
            return None
        photographs = data.get("photographs")
        return cls(Path(photographs) if photographs else None, data.get("settings", {}))

    def write(self, folder: Path) -> None:
        """Write it atomically. Raises OSError."""
        photographs = str(self.photographs) if self.photographs else None
        write_sealed(folder / RUN_FILE, {"photographs": photographs, "settings": self.settings})

    def updated(self, settings: Mapping[str, Any]) -> RunFile:
        """With the settings (dataclasses by stage name) of some stages replaced."""
        changed = {name: settings_to_data(value) for name, value in settings.items()}
        return RunFile(self.photographs, {**self.settings, **changed})

    def settings_of(self, stages: Sequence[Stage]) -> dict[str, Any]:
        """Settings dataclasses of all stages: as recorded, otherwise the defaults."""
        return {
            stage.name: settings_from_data(stage.settings_type, self.settings.get(stage.name, {}))
            for stage in stages
        }
