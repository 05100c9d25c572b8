"""What tables name as "module:name", imported when it is first wanted."""

from __future__ import annotations

import importlib
from typing import Any


def load_object(place: str) -> Any:
    """What `place` ("stages.raster.reference_rasteriser:ReferenceRasteriser") names; its module is
    imported now. Raises ImportError or AttributeError for what is not there."""
    module, _, name = place.partition(":")
    return getattr(importlib.import_module(module), name)
