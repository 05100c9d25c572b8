"""The words of a chain of operations: on the command line, and in a file, one a line.

A new operation: a row in `WORDS`, and what it does in `operations`.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from stages.base.errors import Family, SplatError


@dataclass(frozen=True)
class OperationSyntax:
    """name: as typed, behind two dashes. takes: what its value looks like, "" if it takes none."""

    name: str
    takes: str
    help: str


OPERATIONS = {
    word.name: word
    for word in (
        OperationSyntax("crop", "box:...|sphere:...|hull:FILE|lasso:...", "Keep what lies inside."),
        OperationSyntax(
            "drop", "box:...|sphere:...|hull:FILE|lasso:...", "Leave out what lies inside."
        ),
        OperationSyntax(
            "keep", "CONDITION", "Keep where it is true: 'opacity > 0.1 and scale < 0.5'."
        ),
        OperationSyntax("drop-floaters", "", "Leave out what hangs in empty space."),
        OperationSyntax("rotate", "AXIS:DEGREES", "Turn about the origin: x:90, or 0,1,1:30."),
        OperationSyntax("scale", "X", "Enlarge about the origin."),
        OperationSyntax("move", "X,Y,Z", "Move."),
        OperationSyntax(
            "up", "AXIS", "Turn what points there upward: -y as it is, +z, or 0,-1,0.1."
        ),
        OperationSyntax("merge", "FILE", "Add the splats of another file."),
        OperationSyntax("degree", "N", "View-dependent colour of this degree at most, 0 to 3."),
        OperationSyntax("decimate", "N", "At most so many splats, or 25%: neighbours become one."),
        OperationSyntax(
            "max-mb", "MB", "As many splats as fit into the file: neighbours become one."
        ),
    )
}


@dataclass(frozen=True)
class ParsedOperation:
    """One operation as it was asked for."""

    word: str
    value: str = ""

    def __str__(self) -> str:
        return f"--{self.word} {self.value}".rstrip()


def parse_file(path: Path) -> list[ParsedOperation]:
    """The operations of a text file: one a line, dashes before it or not, quotes around its value
    or not; # begins a remark. Raises SplatError "edit-ops"."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is no text"
        raise _wrong(f"{path} cannot be read: {reason}.") from error
    found = []
    for number, line in enumerate(lines, 1):
        line = re.sub(r"(^|\s)#.*", "", line).strip()
        if line:
            found.append(_of_line(line, f"{path}, line {number}"))
    return found


def _of_line(line: str, where: str) -> ParsedOperation:
    word, value = re.fullmatch(r"(?:--)?([^\s=]*)[\s=]*(.*)", line).groups()  # type: ignore[union-attr]
    if word not in OPERATIONS:
        raise _wrong(f"{where}: {word[:40]!r} is no operation.")
    if value[:1] in ("'", '"') and value[-1] == value[0] and len(value) > 1:
        value = value[1:-1]
    if bool(value) != bool(OPERATIONS[word].takes):
        raise _wrong(f"{where}: {word} takes {OPERATIONS[word].takes or 'no value'}.")
    return ParsedOperation(word, value)


def format_operations(operations: Iterable[ParsedOperation]) -> str:
    """What `from_file` reads."""
    return "".join(f"{parsed.word} {parsed.value}".rstrip() + "\n" for parsed in operations)


def _wrong(given: str) -> SplatError:
    return SplatError(
        "edit-ops",
        given=given,
        wanted=f"Operations, one a line: {', '.join(OPERATIONS)}.",
        hint="For example: crop box:-1,-1,-1,1,1,1",
        family=Family.USAGE,
    )
