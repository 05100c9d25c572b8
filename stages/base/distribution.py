"""The name and the version under which the project is distributed; the command is `splat`.

`pyproject.toml` takes the version from here; a test compares the names.
"""

from __future__ import annotations

NAME = "splatcli"
VERSION = "0.2.0"


def install_command(extra: str = "") -> str:
    """What to type to install the project; extra: a set of optional dependencies ("cluster")."""
    return f'pip install "{NAME}[{extra}]"' if extra else f"pip install {NAME}"
