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
from stages.base.stage import Earlier, Stage
from stages.base.text import counted
from stages.run.digests import FileRecords, damage, differences
from stages.run.manifest import Manifest, json_value, write_json

REQUEST = "request.json"


@dataclass(frozen=True)
class Request:
    """stage: which code runs. settings: JSON data. inputs: digest by name. input_files: records of
    the user's own files behind an input."""

    stage: Stage
    settings: dict[str, Any]
    inputs: dict[str, str]
    input_files: dict[str, FileRecords]

    def key(self) -> dict[str, Any]:
        """What must be equal to resume an interrupted attempt, as JSON data. Settings that do not
        affect the output, and those that may change on resuming ("midway"), are left out."""
        every = settings_of(self.stage.settings_type)
        free = {one.name for one in every if one.midway or not one.affects_output}
        settings = {k: v for k, v in self.settings.items() if k not in free}
        return {"version": self.stage.version, "settings": settings, "inputs": self.inputs}

    def write(self, folder: Path) -> None:
        """Write the request into a working folder. Raises OSError."""
        write_json(folder / REQUEST, self.key())

    def matches(self, folder: Path) -> bool:
        """Whether the work in a folder was begun for an equal request."""
        try:
            left = json.loads((folder / REQUEST).read_text(encoding="utf-8"))
        except (OSError, ValueError, RecursionError):
            return False
        return bool(left == json.loads(json.dumps(self.key())))


def settings_to_data(settings: Any) -> dict[str, Any]:
    """A settings dataclass as JSON holds it."""
    data: dict[str, Any] = json_value(asdict(settings))
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


def earlier_of(request: Request, done: Manifest | None, folder: Path) -> Earlier | None:
    """What the stage may take from its finished output in `folder`; see `Earlier`. None if there is
    nothing, or a file is not as it was written. Raises OSError."""
    stage = request.stage
    if not stage.adds or done is None or done.version != stage.version:
        return None
    deciding = {one.name for one in settings_of(stage.settings_type) if one.affects_output}
    if any(request.settings[n] != done.settings.get(n) for n in deciding - {stage.adds}):
        return None
    if damage(folder, done.outputs, read_all=True):
        return None
    same = frozenset(n for n, digest in request.inputs.items() if done.inputs.get(n) == digest)
    outputs = frozenset(done.outputs)
    return Earlier(folder, done.settings, done.metrics, done.warnings, same, outputs)


def why_again(request: Request, done: Manifest) -> list[str]:
    """The differences between a request and the finished run, as text; [] if there are none."""
    reasons = []
    if request.stage.version != done.version:
        reasons.append(f"new version of the stage ({done.version} -> {request.stage.version})")
    reasons += _settings_changes(request, done)
    for name in sorted(request.inputs.keys() | done.inputs.keys()):
        if request.inputs.get(name) != done.inputs.get(name):
            reasons += _input_changes(name, request, done)
    return reasons


def _settings_changes(request: Request, done: Manifest) -> list[str]:
    """["steps 7000 -> 30000"]. A setting that the finished run lacks counts as its default."""
    settings_type = request.stage.settings_type
    before = {**settings_to_data(settings_type()), **done.settings}
    changes = []
    for setting in settings_of(settings_type):
        then, now = before[setting.name], request.settings[setting.name]
        if setting.affects_output and then != now:
            label = setting.name.replace("_", " ")
            changes.append(f"{label} {_show(then)} -> {_show(now)}")
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
