"""Replaces a splat file, and the files beside it that belong to it, once the new one is proven."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from stages.base.atomic import partial_prefix, remove_abandoned_files, sync_folder
from stages.formats.format_table import format_of
from stages.formats.offset import offset_path


@contextmanager
def replacing_asset(path: Path) -> Iterator[Path]:
    """Yield a path of the same name in a temporary folder beside `path`; what was written there
    replaces the asset at `path` when the block ends. If the block raises, nothing is replaced.

    A streamed asset is written in its place, because its writer replaces the earlier one.
    """
    row = format_of(path)
    if row.streamed:
        yield path
        return
    remove_abandoned_files(path.parent)
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=partial_prefix()) as folder:
        temporary = Path(folder) / path.name
        yield temporary
        beside = offset_path(temporary)
        if not row.holds_origin and not beside.exists():
            offset_path(path).unlink(missing_ok=True)
        for file in sorted(Path(folder).iterdir(), key=lambda file: file == temporary):
            os.replace(file, path.with_name(file.name))
        sync_folder(path.parent)
