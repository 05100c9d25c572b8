"""Arguments and options that several commands share, in the form that typer reads."""

from __future__ import annotations

from inspect import Parameter
from pathlib import Path
from typing import Annotated

import typer

from splatcli.options import keyword, option
from stages.base.distribution import install_command
from stages.base.settings import Setting
from stages.formats import FORMATS
from stages.raster.backends import CHOICES

_INSTALL_RAY = install_command("cluster").replace("[", r"\[")  # in rich markup

ENDINGS = ", ".join(f".{ending}" for ending in FORMATS)
STREAMED = "FOLDER/lod-meta.json and FOLDER/tileset.json"

Photos = Annotated[
    Path | None,
    typer.Argument(
        help="Folder of photographs; a run folder, or nothing, continues that run, or with another "
        "--out begins a second run as that one."
    ),
]
Run = Annotated[
    Path | None, typer.Argument(help="Run folder; by default the one in the current folder.")
]
RunOrFile = Annotated[
    Path | None, typer.Argument(help="Run folder or splat file; by default the run here.")
]
Out = Annotated[
    Path | None,
    typer.Option(
        "--out",
        "-o",
        metavar="PATH",
        help="Run folder to make or continue.",
        show_default="run, or run-PHOTOS beside a run of others",
        rich_help_panel="Output",
    ),
]
NoClobber = Annotated[
    bool, typer.Option("--no-clobber", help="Refuse to replace a file.", rich_help_panel="Output")
]
Cluster = Annotated[
    str | None,
    typer.Option(
        metavar="ADDRESS",
        help="Ray cluster that executes runs, or the blocks of one run (HOST:PORT, "
        "ray://HOST:PORT, auto), or local:N for N workers on this machine. It needs "
        f"{_INSTALL_RAY}.",
        show_default="this process",
        rich_help_panel="Advanced",
    ),
]


Backend = Annotated[
    str | None,
    option(
        Setting(
            "backend",
            "--backend",
            str,
            choices=CHOICES,
            help=f"Rendering backend: {', '.join(CHOICES)}; by default the one of the training.",
            panel="Advanced",
        ),
        shown=False,
    ),
]


def _switch(name: str, help: str, *flags: str) -> Parameter:
    """A switch that `console.guarded` reads; see `console.Mode`."""
    return keyword(name, bool, typer.Option(*flags, help=help, rich_help_panel="Output"), False)


QUIET = _switch("quiet", "Print only warnings and results.", "--quiet", "-q")
AS_JSON = _switch("as_json", "Print events and results as lines of JSON.", "--json")
VERBOSE = _switch(
    "verbose",
    "Write a log for a bug report: versions, machine, settings, warnings, tracebacks.",
    "--verbose",
)
