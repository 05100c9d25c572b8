"""The command line, and the Python API of docs/guide/python.md, which is loaded when it is used."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from splatcli.api import Progress as Progress
    from splatcli.api import Scene as Scene
    from splatcli.api import open_run as open_run
    from splatcli.api import process as process
    from stages.base.errors import Interrupted as Interrupted
    from stages.base.errors import SplatError as SplatError
    from stages.formats import read as read
    from stages.formats import write as write
    from stages.scene import Camera as Camera
    from stages.scene import look_at as look_at

_HOMES = {
    "splatcli.api": ("Progress", "Scene", "open_run", "process"),
    "stages.base.errors": ("Interrupted", "SplatError"),
    "stages.formats": ("read", "write"),
    "stages.scene": ("Camera", "look_at"),
}


def __getattr__(name: str) -> object:
    """A name of the API. `splat --help` loads none of them."""
    for home, names in _HOMES.items():
        if name in names:
            return getattr(import_module(home), name)
    raise AttributeError(f"module 'splatcli' has no attribute {name!r}")
