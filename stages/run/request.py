"""The request for a run of a stage: settings, inputs and version.

Equal requests give equal bytes.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, get_args, get_type_hints

from stages.base.settings import settings_of
from stages.base.stage import Stage
from stages.base.text import counted
from stages.run.digests import FileRecords, differences
from stages.run.manifest import Manifest, plain, write_json

REQUEST = "request.json"


@dataclass(frozen=True)
class Request:
    """stage, version: which code runs. settings: plain data. inputs: digest by name. input_files:
    records of the user's own files behind an input."""

    stage: str
    version: int
    settings: dict[str, Any]
    inputs: dict[str, str]
    input_files: dict[str, FileRecords]

    def key(self, settings_type: type) -> dict[str, Any]:
        """What must be equal to resume an interrupted attempt, as plain data. Settings that do not
        affect the output, and those that may change on resuming ("midway"), are left out."""
        midway = {setting.name for setting in settings_of(settings_type) if setting.midway}
        free = _quiet_fields(settings_type) | midway
        settings = {k: v for k, v in self.settings.items() if k not in free}
        return {"version": self.version, "settings": settings, "inputs": self.inputs}

    def write(self, folder: Path, settings_type: type) -> None:
        """Write the request into a working folder. Raises OSError."""
        write_json(folder / REQUEST, self.key(settings_type))

    def matches(self, folder: Path, settings_type: type) -> bool:
        """Whether the work in a folder was begun for an equal request."""
        try:
            left = json.loads((folder / REQUEST).read_text(encoding="utf-8"))
        except (OSError, ValueError, RecursionError):
            return False
        return bool(left == json.loads(json.dumps(self.key(settings_type))))


def settings_to_data(settings: Any) -> dict[str, Any]:
    """A settings dataclass as JSON holds it."""
    data: dict[str, Any] = plain(asdict(settings))
    return data


def settings_from_data(settings_type: type, data: Mapping[str, Any]) -> Any:
    """The inverse of `settings_to_data`. Unknown fields are dropped, missing ones get their
    defaults. Raises TypeError or ValueError if a value does not fit."""
    hints = get_type_hints(settings_type)
    known = {}
    for field in fields(settings_type):
        if field.name in data:
            value = data[field.name]
            known[field.name] = tuple(value) if isinstance(value, list) else value
            if value is not None and Path in (hints[field.name], *get_args(hints[field.name])):
                known[field.name] = Path(value)
    return settings_type(**known)


def why_again(request: Request, done: Manifest, settings_type: type) -> list[str]:
    """The differences between a request and the finished run, as text; [] if there are none."""
    reasons = []
    if request.version != done.version:
        reasons.append(f"new version of the stage ({done.version} -> {request.version})")
    reasons += _settings_changes(request.settings, done.settings, settings_type)
    for name in sorted(request.inputs.keys() | done.inputs.keys()):
        if request.inputs.get(name) != done.inputs.get(name):
            reasons += _input_changes(name, request, done)
    return reasons


def _settings_changes(
    now: Mapping[str, Any], then: Mapping[str, Any], settings_type: type
) -> list[str]:
    """["steps 7000 -> 30000"]. A setting that the finished run lacks counts as its default."""
    defaults = settings_to_data(settings_type())
    quiet = _quiet_fields(settings_type)
    changes = []
    for name, value in now.items():
        before = then.get(name, defaults.get(name))
        if name not in quiet and value != before:
            label = name.replace("_", " ")
            changes.append(f"{label} {_show(before)} -> {_show(value)}")
    return changes


def _input_changes(name: str, request: Request, done: Manifest) -> list[str]:
    if name not in request.input_files:
        return [f"{name} changed"]
    now, then = request.input_files[name], done.input_files.get(name, {})
    what = "photograph" if name == "photos" else f"{name} file"
    changes = [f"{what} {change}" for change in differences(then, now)]
    if len(changes) > 3:
        rest = len(changes) - 3
        return [*changes[:3], f"{counted(rest, f'more {what}')} changed"]
    return changes or [f"{name} changed"]


def _show(value: Any) -> str:
    if isinstance(value, list):
        return " ".join(map(str, value)) or "none"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return "none" if value is None else str(value)


def _quiet_fields(settings_type: type) -> set[str]:
    return {setting.name for setting in settings_of(settings_type) if not setting.affects_output}


def request_for(
    stage: Stage, settings: Any, inputs: dict[str, str], input_files: dict[str, FileRecords]
) -> Request:
    """The request for `stage` with these settings and inputs."""
    return Request(stage.name, stage.version, settings_to_data(settings), inputs, input_files)
