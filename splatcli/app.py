"""The command line: one entry for each command, and the entry point.

The module of a command is imported when the command is used: `splat --help` needs none of them.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from inspect import Parameter
from itertools import chain
from typing import Annotated, Any

import typer
from typer.core import TyperCommand
from typer.main import get_command

from splatcli import run_settings
from splatcli.arguments import AS_JSON, QUIET, VERBOSE
from splatcli.command_group import CommandGroup
from splatcli.console import guarded, take_any_output
from splatcli.help import HelpedCommand
from splatcli.operation_options import OrderedCommand, operation_parameters
from splatcli.options import parameters, with_parameters
from splatcli.render_options import RenderOptions
from splatcli.watched import watched
from stages.base.distribution import NAME, VERSION
from stages.run.stages import STAGE_NAMES

_RESULT = (QUIET, AS_JSON)
_RUN = (*_RESULT, VERBOSE)


@dataclass(frozen=True)
class Entry:
    """A command in the list of commands.

    Args:
        help: its first line.
        example: a command line.
        added: parameters besides those of its function.
        options: () -> more parameters, made when the command is used.
        kind: of the command.
        panel: the heading under which `splat --help` lists it.
    """

    help: str
    example: str
    added: tuple[Parameter, ...] = ()
    options: Callable[[], Iterable[Parameter]] = tuple
    kind: type[TyperCommand] = HelpedCommand
    panel: str = "Scenes"


def _stage(name: str, help: str, example: str) -> Entry:
    parameters = partial(run_settings.stage_parameters, name)
    return Entry(help, example, _RUN, parameters, panel="One stage of a run")


ENTRIES = {
    "process": Entry(
        "Photographs in, assets out: all seven stages.",
        "splat process photos/ --preset preview --out run/",
        _RUN,
        run_settings.process_parameters,
    ),
    "batch": Entry(
        "Many captures: `splat process` for each, into a run folder of its name.",
        "splat batch captures/* --out runs/",
        _RUN,
        run_settings.batch_parameters,
    ),
    "ingest": _stage(
        "ingest", "Read and check the photographs.", "splat ingest photos/ --out run/"
    ),
    "sfm": _stage("sfm", "Find where each photograph was taken from.", "splat sfm"),
    "seed": _stage("seed", "Turn the sparse points into initial splats.", "splat seed"),
    "train": _stage(
        "train", "Optimise the splats on the photographs.", "splat train --preset best"
    ),
    "prune": _stage(
        "prune", "Remove floaters and splats that do not improve the pictures.", "splat prune"
    ),
    "quantise": _stage(
        "quantise",
        "Choose the precision of stored values, and fine-tune the splats to file formats.",
        "splat quantise --format sog",
    ),
    "export": _stage(
        "export",
        "Write the files that other programs open.",
        "splat export --format gltf --format usdz",
    ),
    "edit": Entry(
        "Select, move, join and thin out splats: operations in the order in which they are typed.",
        "splat edit scene.ply chair.sog --crop box:-1,-1,-1,1,1,1 --decimate 50%",
        _RESULT,
        operation_parameters,
        OrderedCommand,
        panel="Files",
    ),
    "status": Entry(
        "Say what is finished, what would run again, and why.",
        "splat status run/",
        (AS_JSON,),
        panel="Look and measure",
    ),
    "render": Entry(
        "Draw the splats: from a photograph's camera, or as a film along a path.",
        "splat render run/ --path orbit --out film.mp4",
        _RESULT,
        lambda: parameters(RenderOptions),
        panel="Look and measure",
    ),
    "view": Entry(
        "Show the splats in a browser: orbit, fly, stand where the photographs were taken.",
        "splat view run/",
        (AS_JSON,),
        panel="Look and measure",
    ),
    "info": Entry(
        "Print statistics of a file or a run: splats, SH degrees, bounds, bytes, and warnings.",
        "splat info run/7-export/scene.ply",
        (AS_JSON,),
        panel="Look and measure",
    ),
    "tradeoff": Entry(
        "Measure quality against time, bytes and number of splats: a report with plots.",
        "splat tradeoff run/",
        _RESULT,
        panel="Look and measure",
    ),
    "compare": Entry(
        "Compare two runs: better, worse, or no significant difference.",
        "splat compare run/ other-run/",
        _RESULT,
        panel="Look and measure",
    ),
    "convert": Entry(
        "Write a splat file in another format.",
        "splat convert scene.ply scene.sog",
        _RESULT,
        panel="Files",
    ),
    "verify": Entry(
        "Verify a file: read it with a second parser, draw it, compare it with what was trained.",
        "splat verify run/7-export/scene.glb",
        _RESULT,
        panel="Files",
    ),
    "cameras": Entry(
        "Write cameras for other programs: those of a run, of nerfstudio or of COLMAP.",
        "splat cameras run/ transforms.json",
        (AS_JSON,),
        panel="Files",
    ),
    "doctor": Entry(
        "Check what this machine has, and what is missing.",
        "splat doctor",
        (AS_JSON,),
        panel="This machine",
    ),
}


def loaded(name: str) -> TyperCommand:
    """The command `name` with its function and all its options."""
    entry = ENTRIES[name]
    if name in STAGE_NAMES:
        function = importlib.import_module("splatcli.commands.process").stage_command(name)
    else:
        function = getattr(importlib.import_module(f"splatcli.commands.{name}"), name)
    one = typer.Typer(add_completion=False, rich_markup_mode="rich")
    one.command(
        name,
        cls=entry.kind,
        help=entry.help if name in STAGE_NAMES else None,
        epilog=f"Example: {entry.example}",
    )(with_parameters(guarded(function), chain(entry.options(), entry.added)))
    command: TyperCommand = get_command(one)  # type: ignore[assignment]
    return command


class _Commands(CommandGroup):
    """All commands, each loaded when it is used; until then its entry stands for it."""

    def __init__(self, **given: Any) -> None:
        super().__init__(**given)
        self.commands = {
            name: TyperCommand(name, help=entry.help, rich_help_panel=entry.panel)
            for name, entry in ENTRIES.items()
        }

    def resolve_command(self, ctx: Any, args: list[str]) -> tuple[str | None, Any, list[str]]:
        name, command, rest = super().resolve_command(ctx, args)
        return name, loaded(name) if name in ENTRIES else command, rest


app = typer.Typer(
    name="splat",
    cls=_Commands,
    help="Turn a folder of photographs into a 3D Gaussian splat that opens everywhere.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    context_settings={"help_option_names": ["-h", "--help"]},
    epilog="Examples:\n\n"
    "splat process photos/\n\n"
    "splat process photos/ --preset preview --format glb --out run/\n\n"
    "splat status\n\n"
    "splat export --format gltf",
)


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"{NAME} {VERSION}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version, is_eager=True, help="Print the version and exit."
        ),
    ] = False,
) -> None:
    pass


def main() -> None:
    """Entry point of the `splat` command."""
    take_any_output()
    watched(app)
