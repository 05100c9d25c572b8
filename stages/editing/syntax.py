"""The syntax of operations on the command line.

To add an operation, add a row to `OPERATIONS` and a case to `operations._prepare`.
"""

from __future__ import annotations

from dataclasses import dataclass


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


_REGION = "box:...|sphere:...|lasso:..."
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
