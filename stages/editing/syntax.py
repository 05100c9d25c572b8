"""The syntax of operations: on the command line, and in a file with one operation a line.

To add an operation, add a row to `OPERATIONS` and a case to `operations.prepare`.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from stages.base.errors import SplatError, UsageError


@dataclass(frozen=True)
class OperationSyntax:
    """One operation.

    Attributes:
        name: as typed after two dashes.
        takes: the form of its value; "" if it takes none.
        help: one sentence for the command line.
    """

    name: str
    takes: str
    help: str


_REGION = "box:...|sphere:...|hull:FILE|lasso:..."
OPERATIONS = {
    operation.name: operation
    for operation in (
        OperationSyntax("crop", _REGION, "Keep the splats inside a region."),
        OperationSyntax("drop", _REGION, "Remove the splats inside a region."),
        OperationSyntax(
            "keep", "CONDITION", "Keep where it is true: 'opacity > 0.1 and scale < 0.5'."
        ),
        OperationSyntax("drop-floaters", "", "Remove floaters: splats in free space."),
        OperationSyntax("rotate", "AXIS:DEGREES", "Rotate about the origin: x:90, or 0,1,1:30."),
        OperationSyntax("scale", "X", "Scale about the origin."),
        OperationSyntax("move", "X,Y,Z", "Move."),
        OperationSyntax(
            "up", "AXIS", "Rotate so that this axis points up: -y as it is, +z, or 0,-1,0.1."
        ),
        OperationSyntax("merge", "FILE", "Add the splats of another file."),
        OperationSyntax("degree", "N", "Limit the SH degree, 0 to 3."),
        OperationSyntax("decimate", "N", "Merge neighbours until N splats remain, or 25%."),
        OperationSyntax("max-mb", "MB", "Merge neighbours until the file is this small."),
    )
}


@dataclass(frozen=True)
class ParsedOperation:
    """One operation with its value."""

    name: str
    value: str = ""

    def __str__(self) -> str:
        return f"--{self.name} {self.value}".rstrip()


def parse_file(path: Path) -> list[ParsedOperation]:
    """The operations of a text file, one a line. Leading dashes and quotes around the value are
    optional; # begins a comment. Raises SplatError "edit-ops"."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (FileNotFoundError, IsADirectoryError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is no text"
        raise _invalid(f"{path} cannot be read: {reason}.") from error
    operations = []
    for number, line in enumerate(lines, 1):
        line = re.sub(r"(^|\s)#.*", "", line).strip()
        if line:
            operations.append(_parse_line(line, f"{path}, line {number}"))
    return operations


def _parse_line(line: str, where: str) -> ParsedOperation:
    name, value = re.fullmatch(r"(?:--)?([^\s=]*)[\s=]*(.*)", line).groups()  # type: ignore[union-attr]
    if name not in OPERATIONS:
        raise _invalid(f"{where}: {name[:40]!r} is no operation.")
    if value[:1] in ("'", '"') and value[-1] == value[0] and len(value) > 1:
        value = value[1:-1]
    if bool(value) != bool(OPERATIONS[name].takes):
        raise _invalid(f"{where}: {name} takes {OPERATIONS[name].takes or 'no value'}.")
    return ParsedOperation(name, value)


def _invalid(given: str) -> SplatError:
    return UsageError(
        "edit-ops",
        given=given,
        wanted=f"Operations, one a line: {', '.join(OPERATIONS)}.",
        hint="For example: crop box:-1,-1,-1,1,1,1",
    )
