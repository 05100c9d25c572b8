"""Reports a command line that cannot be parsed as every other error; exit status 2."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any

import typer
from typer.core import TyperGroup

from splatcli import console
from splatcli.help import print_help
from stages.base.errors import Family, ResourceError, SplatError, UsageError

_UsageError: Any = typer.BadParameter.__base__  # typer does not export it


class CommandGroup(TyperGroup):
    """The commands. The parser's errors become `SplatError` "command-line"."""

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Print the help; `formatter` is not needed."""
        print_help(self, ctx)

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
        # of errors before a command runs, which sets it again
        console.mode.as_json = "--json" in (sys.argv[1:] if args is None else args)
        try:
            status = super().main(
                args, prog_name, complete_var, False, windows_expand_args, **extra
            )
            with console.output_written():
                sys.stdout.flush()  # of help and version, which the parser prints
        except SplatError as error:
            status = console.show_error(error)
        except OSError as error:
            lost = console.output_lost if error.filename is None else _not_installed
            status = console.show_error(lost(error))
        except _UsageError as error:
            if type(error).__name__ == "NoArgsIsHelpError":  # it has shown the help
                status = int(Family.USAGE)
            else:
                status = console.show_error(_as_splat_error(error))
        if standalone_mode:
            sys.exit(status)
        return status


def _not_installed(error: OSError) -> SplatError:
    """Of the parser's own options, the one that installs completion alone writes files."""
    return ResourceError(
        "completion-not-installed",
        given=f"{error.filename}: {error.strerror}.",
        wanted="A home folder that can be written to.",
        hint="Put what `splat --show-completion` prints into a file that your shell reads.",
    )


def _as_splat_error(error: Any) -> SplatError:
    command = error.ctx.command_path if error.ctx is not None else "splat"
    message = error.format_message()
    return UsageError(
        "command-line",
        given=f"{command}: {message}" + "." * (message[-1:] not in (".", "?")),
        wanted="A command with the options and arguments that it knows.",
        hint=f"`{command} --help` lists what there is; put quotes around a path with spaces.",
    )
