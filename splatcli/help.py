"""What `--help` prints: options by panel, their names whole at any width of the terminal."""

from __future__ import annotations

from typing import Any

from rich.console import Console
from rich.panel import Panel
from rich.table import Table
from rich.text import Text
from typer.core import TyperCommand

_WIDEST = 26  # of a name and its value in one line


class HelpedCommand(TyperCommand):
    """A command whose help this module prints."""

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Print the help; `formatter` is not needed."""
        print_help(self, ctx)


def print_help(command: Any, ctx: Any) -> None:
    """Print usage, help, the panels of arguments, options and commands, and the examples."""
    console = Console(highlight=False)
    usage = " ".join(command.collect_usage_pieces(ctx))
    console.print(Text(f"\nUsage: {ctx.command_path} {usage}\n", style="bold"))
    for paragraph in _paragraphs(command.help):
        console.print(paragraph, end="\n\n")
    panels: dict[str, list[tuple[Text, Text]]] = {}
    for parameter in command.get_params(ctx):
        if getattr(parameter, "hidden", False):
            continue
        argument = parameter.param_type_name == "argument"
        panel = parameter.rich_help_panel or ("Arguments" if argument else "Options")
        panels.setdefault(panel, []).append((_names(parameter, argument), _help(parameter)))
    for name, one in getattr(command, "commands", {}).items():
        row = (Text(name, style="bold cyan"), Text.from_markup(one.help or ""))
        panels.setdefault(one.rich_help_panel or "Commands", []).append(row)
    for title in sorted(panels, key=lambda title: title != "Arguments"):
        console.print(Panel(_table(panels[title]), title=title, title_align="left"))
    for paragraph in _paragraphs(command.epilog):
        console.print(paragraph)


def _paragraphs(text: str | None) -> list[Text]:
    return [Text.from_markup(" ".join(p.split())) for p in (text or "").split("\n\n") if p]


def _names(parameter: Any, argument: bool) -> Text:
    """ "--out, -o PATH"; what would be long, and names that switch off, on lines of their own."""
    metavar = "" if getattr(parameter, "is_flag", False) else parameter.metavar or "TEXT"
    if argument:
        return Text(parameter.name.upper(), style="bold cyan")
    names = Text(", ".join(sorted(parameter.opts, key=len, reverse=True)), style="bold cyan")
    if parameter.secondary_opts:
        names.append("\n" + ", ".join(parameter.secondary_opts))
    space = " " if len(names) + len(metavar) < _WIDEST else "\n  "
    return names.append(space + metavar if metavar else "", style="not bold yellow")


def _help(parameter: Any) -> Text:
    text = Text.from_markup(parameter.help or "")
    shown, default = parameter.show_default, parameter.default
    if not isinstance(shown, str):
        shown = "" if not shown or default in (None, False, "", ()) else str(default)
        if default is True:
            shown = "yes"
    return text.append(f" [default: {shown}]", style="dim") if shown else text


def _table(rows: list[tuple[Text, Text]]) -> Table:
    table = Table.grid(padding=(0, 2, 0, 0), expand=True)
    table.add_column(no_wrap=True)
    table.add_column(ratio=1)
    for row in rows:
        table.add_row(*row)
    return table
