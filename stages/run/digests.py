"""Digests of files and folders, by which changed inputs and outputs are detected."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from stages.base.text import printable_name

UNREADABLE = "unreadable"


@dataclass(frozen=True)
class FileRecord:
    """State of one file. sha256: hexadecimal, or `UNREADABLE`. size: bytes. mtime_ns: when it was
    last modified, nanoseconds."""

    sha256: str
    size: int
    mtime_ns: int


FileRecords = dict[str, FileRecord]


def record_files(
    folder: Path,
    known: Mapping[str, FileRecord] | None = None,
    *,
    leave_out: frozenset[str] = frozenset(),
    users: bool = False,
) -> FileRecords:
    """Every file under `folder` (or `folder` itself if it is a file), by posix name, sorted.

    Args:
        folder: a folder or a file.
        known: earlier records. A file with the same size and modification time keeps its digest
            without being read.
        leave_out: names to skip.
        users: whether the files are the user's own. Then names with a leading dot are left out,
            because desktop programs write such files among photographs, a file without read
            permission is recorded as `UNREADABLE`, and names are made printable, as ingest does.

    Raises OSError.
    """
    known = known or {}
    record = _record_if_readable if users else _record
    if folder.is_file():
        name = printable_name(folder.name)
        return {name: record(folder, known.get(name))}
    records: FileRecords = {}
    for path in sorted(folder.rglob("*")):
        relative = path.relative_to(folder)
        if users and any(part.startswith(".") for part in relative.parts):
            continue
        name = printable_name(relative.as_posix()) if users else relative.as_posix()
        if name not in leave_out and path.is_file():
            records[name] = record(path, known.get(name))
    return records


def _record_if_readable(path: Path, known: FileRecord | None) -> FileRecord:
    if known is not None and known.sha256 == UNREADABLE:
        known = None  # new permissions do not change the time
    try:
        return _record(path, known)
    except PermissionError:
        stat = path.stat()
        return FileRecord(UNREADABLE, stat.st_size, stat.st_mtime_ns)


def _record(path: Path, known: FileRecord | None) -> FileRecord:
    stat = path.stat()
    if known is not None and (known.size, known.mtime_ns) == (stat.st_size, stat.st_mtime_ns):
        return known
    with path.open("rb") as file:
        sha256 = hashlib.file_digest(file, "sha256").hexdigest()
    return FileRecord(sha256, stat.st_size, stat.st_mtime_ns)


def combined_digest(records: Mapping[str, FileRecord]) -> str:
    """One SHA-256 over names and contents; times are left out."""
    whole = hashlib.sha256()
    for name in sorted(records):
        whole.update(f"{len(name.encode())}:{name}:{records[name].sha256}\n".encode())
    return whole.hexdigest()


def differences(old: Mapping[str, FileRecord], new: Mapping[str, FileRecord]) -> list[str]:
    """What changed, as text: ["a.jpg changed", "b.jpg is missing", "c.jpg is new"]."""
    changes = []
    for name in sorted(old.keys() | new.keys()):
        if name not in new:
            changes.append(f"{name} is missing")
        elif name not in old:
            changes.append(f"{name} is new")
        elif old[name].sha256 != new[name].sha256:
            changes.append(f"{name} changed")
    return changes


def damage(
    folder: Path, recorded: Mapping[str, FileRecord], *, read_all: bool = False
) -> list[str]:
    """Which recorded files under `folder` have changed, as text; [] if none has.

    Files that are not in `recorded` are ignored: a viewer may have written some beside ours.
    read_all: whether to read files of the recorded size and time, too.
    """
    changes = []
    for name, record in sorted(recorded.items()):
        path = folder / name
        try:
            if not path.is_file():
                changes.append(f"{name} is missing")
            elif _record(path, None if read_all else record).sha256 != record.sha256:
                changes.append(f"{name} changed")
        except OSError as error:
            changes.append(f"{name} cannot be read ({error.strerror})")
    return changes


def records_from_data(data: Mapping[str, Any]) -> FileRecords:
    """From JSON data. Raises TypeError or AttributeError for another shape."""
    return {name: FileRecord(**value) for name, value in data.items()}
