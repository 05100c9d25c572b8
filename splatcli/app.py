"""The command line: one entry for each command, and the entry point."""

from __future__ import annotations

from collections.abc import Iterable
from inspect import Parameter
from itertools import chain
from typing import Annotated, Any

import typer

from splatcli import run_settings
from splatcli.arguments import AS_JSON, QUIET, VERBOSE
from splatcli.command_group import CommandGroup
from splatcli.commands import (
    batch,
    cameras,
    compare,
    convert,
    doctor,
    edit,
    info,
    process,
    render,
    status,
    tradeoff,
    verify,
    view,
)
from splatcli.console import guarded
from splatcli.operation_options import OrderedCommand, operation_parameters
from splatcli.options import with_parameters
from splatcli.watched import watched
from stages import STAGE_NAMES
from stages.base.distribution import NAME, VERSION

app = typer.Typer(
    name="splat",
    cls=CommandGroup,
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

_STAGES = {  # help and example by stage name
    "ingest": ("Read and check the photographs.", "splat ingest photos/ --out run/"),
    "sfm": ("Find where each photograph was taken from.", "splat sfm"),
    "seed": ("Turn the sparse points into initial splats.", "splat seed"),
    "train": ("Optimise the splats on the photographs.", "splat train --preset best"),
    "prune": ("Remove floaters and splats that do not improve the pictures.", "splat prune"),
    "quantise": (
        "Choose the precision of stored values, and fine-tune the splats to file formats.",
        "splat quantise --format sog",
    ),
    "export": (
        "Write the files that other programs open.",
        "splat export --format gltf --format usdz",
    ),
}


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


def _add(name: str, command: Any, example: str, *added: Iterable[Parameter], **more: Any) -> None:
    """Add a command with the parameters of `added` besides its own."""
    found = with_parameters(guarded(command), chain(*added))
    app.command(name, epilog=f"Example: {example}", **more)(found)


_RESULT = (QUIET, AS_JSON)
_RUN = (*_RESULT, VERBOSE)
_add(
    "process",
    process.process,
    "splat process photos/ --preset preview --out run/",
    *(run_settings.process_parameters(), _RUN),
)
_add(
    "batch",
    batch.batch,
    "splat batch captures/* --out runs/",
    *(run_settings.batch_parameters(), _RUN),
)
for _name in STAGE_NAMES:
    _help, _example = _STAGES[_name]
    _options_of = (run_settings.stage_parameters(_name), _RUN)
    _add(_name, process.stage_command(_name), _example, *_options_of, help=_help)
_add(
    "edit",
    edit.edit,
    "splat edit scene.ply chair.sog --crop box:-1,-1,-1,1,1,1 --decimate 50%",
    *(operation_parameters(), _RESULT),
    cls=OrderedCommand,
)
_add("status", status.status, "splat status run/", [AS_JSON])
_add("render", render.render, "splat render run/ --path orbit --out film.mp4", _RESULT)
_add("view", view.view, "splat view run/")
_add("info", info.info, "splat info run/7-export/scene.ply", [AS_JSON])
_add("tradeoff", tradeoff.tradeoff, "splat tradeoff run/", _RESULT)
_add("compare", compare.compare, "splat compare run/ other-run/", _RESULT)
_add("convert", convert.convert, "splat convert scene.ply scene.sog", _RESULT)
_add("verify", verify.verify, "splat verify run/7-export/scene.glb", _RESULT)
_add("cameras", cameras.cameras, "splat cameras run/ transforms.json", [AS_JSON])
_add("doctor", doctor.doctor, "splat doctor", [AS_JSON])


def main() -> None:
    """Entry point of the `splat` command."""
    watched(app)
