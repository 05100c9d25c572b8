"""Objects that registries name as "module:name", imported at first use."""

from __future__ import annotations

import importlib
from typing import Any


def load_object(path: str) -> Any:
    """Import the module and return the object that `path` ("stages.raster.draw:render") names.

    Raises ImportError or AttributeError if there is none.
    """
    module, _, name = path.partition(":")
    return getattr(importlib.import_module(module), name)
