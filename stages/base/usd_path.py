"""Names of files for the USD library."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from stages.base.text import printable_name


@contextmanager
def accepted_path(path: Path) -> Iterator[str]:
    """A name for the file `path` that the USD library accepts inside the block: it refuses control
    characters."""
    name = str(path.resolve())
    if printable_name(name) == name:
        yield name
        return
    with tempfile.TemporaryDirectory() as folder:
        link = Path(folder) / f"scene{path.suffix}"
        link.symlink_to(name)
        yield str(link)
