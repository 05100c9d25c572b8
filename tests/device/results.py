"""Results of one part of a run: a JSON file that is whole after each result, whatever ends the
process."""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any


class Results:
    """The file `path`: {"table": rows of (what, value, target), name: value}."""

    def __init__(self, path: Path) -> None:
        self.path, self._found = path, {"table": []}  # type: Path, dict[str, Any]

    def put(self, name: str, value: Any) -> None:
        """Keep a value, of whatever JSON can hold."""
        self._found[name] = value
        self._write()

    def row(self, what: str, value: str, target: str = "") -> None:
        """A line of the table that a run ends with."""
        self._found["table"].append((what, value, target))
        print(f"{what}: {value}" + (f" (target: {target})" if target else ""), flush=True)
        self._write()

    @contextmanager
    def attempt(self, what: str) -> Iterator[None]:
        """Keep what an error says, and go on."""
        try:
            yield
        except Exception as error:  # one figure must not cost the others
            said = (str(error).splitlines() or [""])[0]
            self.row(what, f"FAILED: {type(error).__name__}: {said[:160]}")

    def _write(self) -> None:
        beside = self.path.with_suffix(".part")
        beside.write_text(json.dumps(self._found, default=float))
        os.replace(beside, self.path)


def asked(description: str | None, *more: str) -> tuple[argparse.Namespace, Results]:
    """The options of a part, (--result, --toy and `more`, each with a text), and its results."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--result", type=Path, required=True, help="the file of its results")
    parser.add_argument("--toy", action="store_true", help="a few splats, also without a GPU")
    for name in more:
        parser.add_argument(name, default="")
    found = parser.parse_args()
    return found, Results(found.result)
