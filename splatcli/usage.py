"""A command line that cannot be understood: said as every other error is, exit status 2."""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence
from typing import Any

import typer
from typer.core import TyperGroup

from splatcli import console
from stages.base.errors import Family, SplatError

_UsageError: Any = typer.BadParameter.__base__  # typer names it in no place of its own


class Commands(TyperGroup):
    """The commands, with a wrong word told in our words instead of the parser's."""

    def main(
        self,
        args: Sequence[str] | None = None,
        prog_name: str | None = None,
        complete_var: str | None = None,
        standalone_mode: bool = True,
        windows_expand_args: bool = True,
        **extra: Any,
    ) -> Any:
        """Parse and run; ends the process with the exit status if `standalone_mode`."""
        words = sys.argv[1:] if args is None else list(args)
        try:
            status = super().main(
                args, prog_name, complete_var, False, windows_expand_args, **extra
            )
        except SplatError as error:
            status = console.show_error(error, "--json" in words)
        except _UsageError as error:
            if type(error).__name__ == "NoArgsIsHelpError":  # it has shown the help
                status = int(Family.USAGE)
            else:
                status = console.show_error(_explained(error), "--json" in words)
        if standalone_mode:
            sys.exit(status)
        return status


def _explained(error: Any) -> SplatError:
    command = error.ctx.command_path if error.ctx is not None else "splat"
    hint = f"`{command} --help` lists what there is."
    kind = type(error).__name__
    if kind == "NoSuchOption":
        given = f"{command} has no option {error.option_name}."
        if error.possibilities:
            hint = f"Did you mean {' or '.join(error.possibilities)}? {hint}"
    elif kind == "BadOptionUsage":
        given = f"{error.option_name} needs a value."
    elif kind == "MissingParameter":
        given = f"{command} needs a {error.param.name}, and none is named."
    else:
        given, hint = _in_our_words(command, error.format_message(), hint)
    return SplatError(
        "command-line",
        given=given,
        wanted="A command with the options and arguments that it knows.",
        hint=hint,
        family=Family.USAGE,
    )


def _in_our_words(command: str, said: str, hint: str) -> tuple[str, str]:
    """(given, hint) of what the parser tells only as a sentence; its own where that is another."""
    if found := re.fullmatch(r"No such command '(.+?)'\.(?: Did you mean (.+)\?)?", said):
        likely = f"Did you mean {found[2].replace(chr(39), '')}? " if found[2] else ""
        return f"{command} has no command {found[1]}.", likely + hint
    if found := re.fullmatch(r"Got unexpected extra argument(?:s|\(s\))? \((.+)\)", said):
        return (
            f"{command} has no use for {found[1]}.",
            f"Put quotes around a path with spaces, and give each option all of its values. {hint}",
        )
    return said, hint
