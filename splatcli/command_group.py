"""Reports a command line that cannot be parsed as every other error; exit status 2."""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence
from typing import Any

import typer
from typer.core import TyperGroup

from splatcli import console
from stages.base.errors import Family, SplatError, UsageError

_UsageError: Any = typer.BadParameter.__base__  # typer does not export it


class CommandGroup(TyperGroup):
    """The commands. The parser's errors become `SplatError` "command-line"."""

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
                status = console.show_error(_as_splat_error(error), "--json" in words)
        if standalone_mode:
            sys.exit(status)
        return status


def _as_splat_error(error: Any) -> SplatError:
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
        given, hint = _reworded(command, error.format_message(), hint)
    return UsageError(
        "command-line",
        given=given,
        wanted="A command with the options and arguments that it knows.",
        hint=hint,
    )


def _reworded(command: str, message: str, hint: str) -> tuple[str, str]:
    """(given, hint) for a parser's message; the message itself if it is not a known one."""
    if found := re.fullmatch(r"No such command '(.+?)'\.(?: Did you mean (.+)\?)?", message):
        likely = f"Did you mean {found[2].replace(chr(39), '')}? " if found[2] else ""
        return f"{command} has no command {found[1]}.", likely + hint
    if found := re.fullmatch(r"Got unexpected extra argument(?:s|\(s\))? \((.+)\)", message):
        return (
            f"{command} does not accept {found[1]}.",
            f"Put quotes around a path with spaces, and give each option all of its values. {hint}",
        )
    return message, hint
