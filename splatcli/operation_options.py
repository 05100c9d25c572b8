"""Options whose order matters: what `splat edit` does, one after the other."""

from __future__ import annotations

from collections.abc import Iterator
from inspect import Parameter
from pathlib import Path
from typing import Any

import typer
from typer.core import TyperCommand

from splatcli.options import keyword
from stages.editing.syntax import OPERATIONS, ParsedOperation, parse_file

_OPS = "ops"
_TYPED = "splat.typed"  # where a context keeps the words of its command


class Chain(TyperCommand):
    """A command that remembers its words: a parser hands them out sorted by option."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        ctx.meta[_TYPED] = tuple(args)
        return super().parse_args(ctx, args)


def chain_parameters() -> list[Parameter]:
    """One keyword parameter an operation, each as often as one likes, and --ops."""
    found = [
        keyword(
            word.name.replace("-", "_"),
            list[str] | None if word.takes else bool,
            typer.Option(
                f"--{word.name}",
                help=word.help,
                show_default=False,
                metavar=word.takes or None,
            ),
            None if word.takes else False,
        )
        for word in OPERATIONS.values()
    ]
    told = "Text file of operations, one a line: done where it stands."
    option = typer.Option(f"--{_OPS}", help=told, show_default=False, metavar="FILE")
    return [*found, keyword(_OPS, list[str] | None, option)]


def typed_in(ctx: typer.Context) -> list[ParsedOperation]:
    """The operations in the order in which they were typed, those of files in their place. The
    parser has let the words pass. Raises SplatError "edit-ops"."""
    return list(_operations(iter(ctx.meta[_TYPED])))


def _operations(words: Iterator[str]) -> Iterator[ParsedOperation]:
    for word in words:
        if word == "--":
            return
        flag, given, value = word.partition("=")
        name = flag.removeprefix("--") if flag.startswith("--") else ""
        if name != _OPS and name not in OPERATIONS:
            continue
        if name == _OPS:
            yield from parse_file(Path(value if given else next(words)))
        elif OPERATIONS[name].takes:
            yield ParsedOperation(name, value if given else next(words))
        else:
            yield ParsedOperation(name)
