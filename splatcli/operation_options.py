"""The options of `splat edit`, whose order on the command line is the order of the operations."""

from __future__ import annotations

from inspect import Parameter
from typing import Any

import typer

from splatcli.help import HelpedCommand
from splatcli.options import keyword
from stages.editing.syntax import OPERATIONS, ParsedOperation

_ORDER = "splat.order"  # the key of (option, value) pairs in the context's `meta`


class OrderedCommand(HelpedCommand):
    """A command that keeps the order of its options: the parser groups their values by option."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        found, _, order = self.make_parser(ctx).parse_args(list(args))
        values = {name: iter(value) for name, value in found.items() if isinstance(value, list)}
        ctx.meta[_ORDER] = [(one.name, next(values.get(one.name, iter(())), "")) for one in order]
        return super().parse_args(ctx, args)


def operation_parameters() -> list[Parameter]:
    """One repeatable keyword parameter for each operation."""
    parameters = []
    for operation in OPERATIONS.values():
        option = typer.Option(
            f"--{operation.name}",
            help=operation.help,
            show_default=False,
            metavar=operation.takes or None,
        )
        name = operation.name.replace("-", "_")
        if operation.takes:
            parameters.append(keyword(name, list[str] | None, option))
        else:
            parameters.append(keyword(name, bool, option, False))
    return parameters


def parsed_operations(ctx: typer.Context) -> list[ParsedOperation]:
    """The operations in the order on the command line."""
    named = ((option.replace("_", "-"), value) for option, value in ctx.meta[_ORDER])
    return [ParsedOperation(name, value) for name, value in named if name in OPERATIONS]
