"""Errors of readers about files that they cannot use."""

from __future__ import annotations

import struct
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from stages.base.disk import not_permitted
from stages.base.errors import Family, SplatError
from stages.base.text import reason_of


class BadFileError(ValueError):
    """What a reader found wrong; `reading` adds the file's name. hint: what to do, where it is not
    what the `FileKind` says."""

    def __init__(self, reason: str, hint: str = "") -> None:
        super().__init__(reason)
        self.hint = hint


@dataclass(frozen=True)
class FileKind:
    """What a file was read as, and the texts of the error."""

    code: str
    what: str
    wanted: str
    hint: str
    family: Family = Family.INPUT


SPLATS = FileKind(
    "splats-unreadable",
    "splats",
    "A whole file of Gaussian splats in the format that its suffix names.",
    "Copy or export the file again; if it comes from another program, try its .ply.",
)
CAMERAS = FileKind(
    "cameras-unreadable",
    "cameras",
    "A whole file of cameras in one of the formats that docs/guide/captures.md lists.",
    "Export the cameras again; a run's own are written by `splat cameras RUN OUT`.",
)


def stage_output(code: str) -> FileKind:
    """A file that a stage wrote into a run folder. code: of the error."""
    return FileKind(
        code,
        "the output of its stage",
        "The file as the stage wrote it.",
        "Delete the stage's folder and run the command again; it is then made again.",
        Family.RUN_FOLDER,
    )


@contextmanager
def reading(path: Path, kind: FileKind = SPLATS) -> Iterator[None]:
    """Turn exceptions inside the block into a SplatError of `kind` that names `path`.

    Besides `BadFileError` these are the exceptions that damaged bytes cause in Python and NumPy.
    RecursionError comes from deeply nested JSON, MemoryError from a file larger than memory.
    """
    try:
        if not path.exists():
            raise BadFileError("there is no such file")
        if not path.is_file():  # a folder; or a pipe or device, on which a reader would hang
            raise BadFileError("it is not a regular file")
        if path.stat().st_size == 0:
            raise BadFileError("it is empty")
        yield
    except PermissionError as error:
        raise not_permitted(path, error) from error
    except OSError as error:
        raise _unreadable(path, kind, error.strerror or str(error)) from error
    except MemoryError as error:
        raise _unreadable(path, kind, "it needs more memory than there is") from error
    except (
        ValueError,
        LookupError,
        TypeError,
        AttributeError,  # of a JSON list where an object is wanted
        OverflowError,
        RecursionError,
        EOFError,
        NotImplementedError,  # of zip files of a later version
        zipfile.BadZipFile,
        zlib.error,
        struct.error,
    ) as error:
        if isinstance(error, BadFileError):
            raise _unreadable(path, kind, str(error), error.hint) from error
        raise _unreadable(path, kind, f"it is damaged ({reason_of(error)})") from error


def _unreadable(path: Path, kind: FileKind, reason: str, hint: str = "") -> SplatError:
    return SplatError(
        kind.code,
        given=f"{path} cannot be read as {kind.what}: {reason}.",
        wanted=kind.wanted,
        hint=hint or kind.hint,
        family=kind.family,
    )
