"""Replaces a splat file, and the files beside it that belong to it, once the new one is proven."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from stages.base.atomic import remove_abandoned_files, sync_folder, temporary_beside
from stages.base.errors import SplatError, UsageError
from stages.formats.codecs import CODECS
from stages.formats.format_table import format_of
from stages.formats.gltf_file import refuse_taken_buffer
from stages.formats.offset import offset_path

_LONGEST_NAME_BYTES = 220  # of the 255 that file systems allow


@contextmanager
def replacing_asset(path: Path) -> Iterator[Path]:
    """Yield a path of the same name in a temporary folder beside `path`; what was written there
    replaces the asset at `path` when the block ends. If the block raises, nothing is replaced."""
    row = format_of(path)
    remove_abandoned_files(path.parent)
    with temporary_beside(path) as temporary:
        yield temporary
        if move := CODECS[row.ending].move:
            return move(temporary, path)
        beside = offset_path(temporary)
        if not row.holds_origin and not beside.exists():
            offset_path(path).unlink(missing_ok=True)
        for file in sorted(temporary.parent.iterdir(), key=lambda file: file == temporary):
            os.replace(file, path.with_name(file.name))
        sync_folder(path.parent)


def check_target(path: Path, no_clobber: bool, source: Path | None = None) -> None:
    """Raise SplatError for a file that must not be written: "target-is-source" for `source`,
    "target-exists" with `no_clobber` if it, or a file that belongs to it, exists,
    "gltf-buffer-taken" where another file has the name of its buffer, "name-too-long" where names
    that are made of it would be too long for a file system."""
    row = format_of(path)
    if (length := len(os.fsencode(path.name))) > _LONGEST_NAME_BYTES:
        raise SplatError(
            "name-too-long",
            given=f"{path.name[:40]}... is a name of {length} bytes.",
            wanted=f"At most {_LONGEST_NAME_BYTES}: files beside it have longer names.",
            hint="Use a shorter one.",
        )
    if source and path.exists() and source.exists() and path.samefile(source):
        raise UsageError(
            "target-is-source",
            given=f"{path} is the file that is read.",
            wanted="Another name: the values of a file are not the same once they are converted.",
            hint=f"For example {path.with_name('new-' + path.name)}",
        )
    sidecar = path.with_suffix(row.sidecar) if row.sidecar else path
    for file in (path, sidecar, path if row.holds_origin else offset_path(path)):
        if no_clobber and os.path.lexists(file):
            raise UsageError(
                "target-exists",
                given=f"{file} exists.",
                wanted="A new name, because of --no-clobber.",
                hint="Name another file, or leave --no-clobber away.",
            )
    if row.ending == "gltf":
        refuse_taken_buffer(path)
