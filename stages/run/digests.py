"""Digests of files and folders: how an input or an output is recognised again."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

UNREADABLE = "unreadable"


@dataclass(frozen=True)
class FileRecord:
    """One file as it was seen. sha256: hexadecimal, or `UNREADABLE`. size: bytes. mtime_ns:
    nanoseconds."""

    sha256: str
    size: int
    mtime_ns: int


FileRecords = dict[str, FileRecord]


def sha256_file(path: Path) -> str:
    """Hexadecimal SHA-256 of a file's bytes. Raises OSError."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def record_files(
    folder: Path,
    known: Mapping[str, FileRecord] | None = None,
    *,
    leave_out: frozenset[str] = frozenset(),
    users: bool = False,
) -> FileRecords:
    """Every file under `folder` (or `folder` itself if it is a file), by posix name, sorted.

    known: earlier records; a file whose size and modification time are unchanged keeps its digest
        unread, which makes a second look at a large folder cheap. An edited file has another time.
    leave_out: names to skip. users: whether the files are the user's own: then names with a leading
        dot do not count, since desktop programs drop such files among photographs, and a file that
        may not be read is recorded as that.
    Raises OSError.
    """
    known = known or {}
    record = _record_if_readable if users else _record
    if folder.is_file():
        return {folder.name: record(folder, known.get(folder.name))}
    found: FileRecords = {}
    for path in sorted(folder.rglob("*")):
        relative = path.relative_to(folder)
        if users and any(part.startswith(".") for part in relative.parts):
            continue
        name = relative.as_posix()
        if name not in leave_out and path.is_file():
            found[name] = record(path, known.get(name))
    return found


def _record_if_readable(path: Path, known: FileRecord | None) -> FileRecord:
    if known is not None and known.sha256 == UNREADABLE:
        known = None  # a change of permissions is no change of time
    try:
        return _record(path, known)
    except PermissionError:
        stat = path.stat()
        return FileRecord(UNREADABLE, stat.st_size, stat.st_mtime_ns)


def _record(path: Path, known: FileRecord | None) -> FileRecord:
    stat = path.stat()
    if known is not None and (known.size, known.mtime_ns) == (stat.st_size, stat.st_mtime_ns):
        return known
    return FileRecord(sha256_file(path), stat.st_size, stat.st_mtime_ns)


def combined_digest(records: Mapping[str, FileRecord]) -> str:
    """One SHA-256 over names and contents; times do not count."""
    whole = hashlib.sha256()
    for name in sorted(records):
        whole.update(f"{len(name.encode())}:{name}:{records[name].sha256}\n".encode())
    return whole.hexdigest()


def differences(old: Mapping[str, FileRecord], new: Mapping[str, FileRecord]) -> list[str]:
    """In words, what changed: ["a.jpg changed", "b.jpg is missing", "c.jpg is new"]."""
    words = []
    for name in sorted(old.keys() | new.keys()):
        if name not in new:
            words.append(f"{name} is missing")
        elif name not in old:
            words.append(f"{name} is new")
        elif old[name].sha256 != new[name].sha256:
            words.append(f"{name} changed")
    return words


def damage(folder: Path, recorded: Mapping[str, FileRecord]) -> list[str]:
    """In words, which recorded files under `folder` are not what they were; [] when whole.

    Files that are not in `recorded` do not count: a viewer may have left some beside ours.
    """
    words = []
    for name, record in sorted(recorded.items()):
        path = folder / name
        try:
            if not path.is_file():
                words.append(f"{name} is missing")
            elif _record(path, record).sha256 != record.sha256:
                words.append(f"{name} changed")
        except OSError as error:
            words.append(f"{name} cannot be read ({error.strerror})")
    return words


def records_to_data(records: Mapping[str, FileRecord]) -> dict[str, Any]:
    """Plain data for JSON."""
    return {name: asdict(record) for name, record in sorted(records.items())}


def records_from_data(data: Mapping[str, Any]) -> FileRecords:
    """The inverse of `records_to_data`. Raises TypeError or AttributeError for another shape."""
    return {name: FileRecord(**value) for name, value in data.items()}
