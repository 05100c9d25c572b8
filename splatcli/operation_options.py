"""The options of `splat edit`, whose order on the command line is the order of the operations."""

from __future__ import annotations

from collections.abc import Iterator
from inspect import Parameter
from pathlib import Path
from typing import Any

import typer
from typer.core import TyperCommand

from splatcli.options import keyword
from stages.editing.syntax import OPERATIONS, ParsedOperation, parse_file

_FILE_OPTION = "ops"
_WORDS = "splat.words"  # the key of the command's words in the context's `meta`


class OrderedCommand(TyperCommand):
    """A command that keeps its words: the parser groups them by option."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        ctx.meta[_WORDS] = tuple(args)
        return super().parse_args(ctx, args)


def operation_parameters() -> list[Parameter]:
    """One repeatable keyword parameter for each operation, and --ops."""
    found = []
    for operation in OPERATIONS.values():
        option = typer.Option(
            f"--{operation.name}",
            help=operation.help,
            show_default=False,
            metavar=operation.takes or None,
        )
        name = operation.name.replace("-", "_")
        if operation.takes:
            found.append(keyword(name, list[str] | None, option))
        else:
            found.append(keyword(name, bool, option, False))
    option = typer.Option(
        f"--{_FILE_OPTION}",
        help="Text file of operations, one a line, which are inserted here.",
        show_default=False,
        metavar="FILE",
    )
    return [*found, keyword(_FILE_OPTION, list[str] | None, option)]


def parsed_operations(ctx: typer.Context) -> list[ParsedOperation]:
    """The operations in the order on the command line, those of files in the place of --ops. The
    parser has accepted the words. Raises SplatError "edit-ops"."""
    return list(_operations(iter(ctx.meta[_WORDS])))


def _operations(words: Iterator[str]) -> Iterator[ParsedOperation]:
    for word in words:
        if word == "--":
            return
        flag, given, value = word.partition("=")
        name = flag.removeprefix("--") if flag.startswith("--") else ""
        if name != _FILE_OPTION and name not in OPERATIONS:
            continue
        if name == _FILE_OPTION:
            yield from parse_file(Path(value if given else next(words)))
        elif OPERATIONS[name].takes:
            yield ParsedOperation(name, value if given else next(words))
        else:
            yield ParsedOperation(name)
