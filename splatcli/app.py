"""The command: parse, call, print."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from splatcli import summary
from splatcli.commands import process as commands_process
from splatcli.console import guarded
from splatcli.folders import find_run_folder
from splatcli.operation_options import Chain, chain_parameters, typed_in
from splatcli.options import number, option, with_parameters
from splatcli.usage import Commands
from stages import STAGE_NAMES
from stages.base.distribution import NAME, VERSION, install_command
from stages.base.settings import Setting
from stages.formats import FORMATS
from stages.raster.backends import CHOICES
from stages.raster.torch_device import DEVICES
from stages.run.pipeline import Pipeline

app = typer.Typer(
    name="splat",
    cls=Commands,
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

Photos = Annotated[
    Path | None,
    typer.Argument(help="Folder of photographs; a run folder, or nothing, continues that run."),
]
Out = Annotated[
    Path | None,
    typer.Option(
        "--out",
        "-o",
        help="Run folder to make or continue.",
        show_default="run",
        rich_help_panel="Output",
    ),
]
Run = Annotated[
    Path | None, typer.Argument(help="Run folder; by default the one in the current folder.")
]
Backend = Annotated[
    str | None,
    option(
        Setting(
            "backend",
            "--backend",
            str,
            choices=CHOICES,
            help=f"What draws: {', '.join(CHOICES)}; by default what the run was trained with.",
        ),
        shown=False,
    ),
]
Cluster = Annotated[
    str | None,
    typer.Option(
        metavar="ADDRESS",
        help="Ray cluster that takes runs, or one run's blocks and shares of its matching "
        "(HOST:PORT, ray://HOST:PORT, auto), or local:N for N workers of this machine: "
        f"{install_command('cluster').replace('[', chr(92) + '[')}.",
        show_default="this process",
        rich_help_panel="Advanced",
    ),
]
Device = Annotated[
    str | None,
    option(
        Setting(
            "device",
            "--device",
            str,
            choices=DEVICES,
            help=f"What --backend reference draws on: {', '.join(DEVICES)}.",
        ),
        shown=False,
    ),
]
Quiet = Annotated[
    bool,
    typer.Option(
        "--quiet", "-q", help="Print only warnings and results.", rich_help_panel="Output"
    ),
]
AsJson = Annotated[
    bool,
    typer.Option(
        "--json", help="Print events and results as lines of JSON.", rich_help_panel="Output"
    ),
]

_ENDINGS = ", ".join(f".{ending}" for ending in FORMATS)
_STAGE_HELP = {
    "ingest": "Read and check the photographs.",
    "sfm": "Find where each photograph was taken from.",
    "seed": "Turn the sparse points into first splats.",
    "train": "Fit the splats to the photographs.",
    "prune": "Remove floaters and splats that do not improve the pictures.",
    "quantise": "Choose the precision at which each value is kept.",
    "export": "Write the files that other programs open.",
}
_STAGE_EXAMPLES = {
    "ingest": "splat ingest photos/ --out run/",
    "train": "splat train --preset best",
    "export": "splat export --format gltf --format usdz",
}


def _example(line: str) -> str:
    return f"Example: {line}"


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


def process(
    photos: Photos = None,
    *,
    out: Out = None,
    cluster: Cluster = None,
    quiet: Quiet = False,
    as_json: AsJson = False,
    **given: Any,
) -> None:
    """Photographs in, assets out: all seven stages.

    Finished work is kept: after an interruption the same command goes on where it stopped.
    """
    commands_process.run_all(photos, out, cluster, given, quiet, as_json)


def batch(
    captures: Annotated[
        list[str],
        typer.Argument(
            help="Folders of photographs, or videos: one run for each. Also URLs that fsspec "
            "knows, such as 's3://bucket/captures/*'."
        ),
    ],
    *,
    out: Annotated[
        str,
        typer.Option("--out", "-o", help="Folder, or URL, for the run folders and batch.csv."),
    ] = "runs",
    cluster: Cluster = None,
    quiet: Quiet = False,
    as_json: AsJson = False,
    **given: Any,
) -> None:
    """Many captures: `splat process` for each, into a run folder of its name.

    One that fails does not keep the others; the exit status is the worst. The same command again
    goes on where it stopped: what is finished is not done twice. batch.csv says how they went.
    """
    from splatcli.commands import batch as work

    work.batch(captures, out, cluster, given, quiet, as_json)


def _stage_command(name: str) -> Callable[..., None]:
    def ingest(
        photos: Photos = None,
        *,
        out: Out = None,
        quiet: Quiet = False,
        as_json: AsJson = False,
        **given: Any,
    ) -> None:
        pipeline = Pipeline(*commands_process.target_of(photos, out))
        commands_process.run_stage("ingest", pipeline, given, quiet, as_json)

    def later(
        run: Run = None, *, quiet: Quiet = False, as_json: AsJson = False, **given: Any
    ) -> None:
        commands_process.run_stage(name, Pipeline(find_run_folder(run)), given, quiet, as_json)

    return ingest if name == "ingest" else later


def status(run: Run = None, as_json: AsJson = False) -> None:
    """Say what is finished, what would run again, and why."""
    pipeline = Pipeline(find_run_folder(run))
    summary.show_status(pipeline, pipeline.status(), as_json)


def render(
    target: Annotated[
        Path | None, typer.Argument(help="Run folder or splat file; by default the run here.")
    ] = None,
    *,
    out: Annotated[
        Path,
        typer.Option("--out", "-o", help="Picture (.png), film (.mp4) or folder of frames."),
    ] = Path("view.png"),
    camera: Annotated[
        str | None,
        typer.Option(help="A photograph's name or number; by default the first, or one in front."),
    ] = None,
    path: Annotated[
        str | None,
        typer.Option(
            help="For films and frames: orbit, capture (past the photographs' cameras), or a "
            "camera file (transforms.json, COLMAP folder).",
            show_default="orbit",
        ),
    ] = None,
    frames: Annotated[
        int | None, number("--frames", int, 1, 100_000, "How many frames along the path.")
    ] = None,
    seconds: Annotated[
        float | None,
        number("--seconds", float, 0.01, 3600, "How long the film lasts.", "by path"),
    ] = None,
    fps: Annotated[float, number("--fps", float, 1, 240, "Frames a second.")] = 30.0,
    width: Annotated[
        int | None, number("--width", int, 1, 16384, "Width of the picture (pixels).")
    ] = None,
    depth: Annotated[
        bool,
        typer.Option("--depth", help="Depth too: .depth.tiff of 32-bit floats, or .depth.mp4."),
    ] = False,
    backend: Backend = None,
    device: Device = None,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> None:
    """Draw the splats: as a photograph saw them, or as a film along a path.

    Frames that are in the folder already are written again. Depth is z in world units, 0 where
    there is nothing; in films it is light where near.
    """
    from splatcli.commands import render as work

    work.render(
        target,
        work.Wanted(
            *(out, camera, path, frames, seconds, fps, width, depth, backend, device),
            quiet=quiet,
            as_json=as_json,
        ),
    )


def view(
    target: Annotated[
        Path | None, typer.Argument(help="Run folder or splat file; by default the run here.")
    ] = None,
    *,
    port: Annotated[
        int, number("--port", int, 0, 65535, "Port to serve on; 0 for any that is free.")
    ] = 0,
    open_browser: Annotated[
        bool, typer.Option("--open/--no-open", help="Open the browser, or only print the address.")
    ] = True,
) -> None:
    """Look at the splats in a browser: orbit, fly, stand where the photographs were taken.

    The page is served to this machine only and needs no network. Ctrl-C ends it.
    """
    from splatcli.commands import view as work

    work.show(target, port, open_browser)


def info(
    target: Annotated[
        Path | None, typer.Argument(help="Run folder or splat file; by default the run here.")
    ] = None,
    speed: Annotated[
        bool, typer.Option("--speed", help="Draw some pictures too: frames a second, here.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Count the splats of a file or a run: degrees, bounds, bytes, and what is wrong with them."""
    from splatcli.commands import info as work

    work.show(target, speed, as_json)


def tradeoff(
    run: Run = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Folder for the report.", show_default="RUN/tradeoff"),
    ] = None,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> None:
    """Measure what time, bytes and splats are worth in this scene: a report with plots.

    Judged on photographs that training never saw. Nothing is trained: the course of training comes
    from its log, files are really written and read, splats are taken away by what they are worth.
    """
    from splatcli.commands import tradeoff as work

    work.tradeoff(run, out, quiet, as_json)


def compare(
    first: Annotated[Path, typer.Argument(help="Run folder.")],
    second: Annotated[Path, typer.Argument(help="Another, of the same photographs.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the report.")] = Path(
        "comparison"
    ),
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> None:
    """Put two runs side by side: better, worse, or not told apart.

    Both are judged at one size on photographs that neither learnt from, photograph by photograph.
    """
    from splatcli.commands import compare as work

    work.compare(first, second, out, quiet, as_json)


def convert(
    source: Annotated[Path, typer.Argument(help="Splat file to read; its name says the format.")],
    target: Annotated[Path, typer.Argument(help=f"Splat file to write: {_ENDINGS}.")],
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> None:
    """Make a splat file into one of another format."""
    from splatcli.commands import convert as work

    work.convert(source, target, quiet, as_json)


def edit(
    ctx: typer.Context,
    source: Annotated[Path, typer.Argument(help="Splat file, or a run folder for its splats.")],
    target: Annotated[
        Path | None,
        typer.Argument(help=f"Splat file to write: {_ENDINGS}; FOLDER/lod-meta.json to stream."),
    ] = None,
    *,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Say what would become of it, and write nothing.")
    ] = False,
    quiet: Quiet = False,
    as_json: AsJson = False,
    **operations: Any,
) -> None:
    """Select, move, join and thin out splats: operations in the order in which they are typed.

    Coordinates are those of `splat info`: y down, less the capture's origin. Where the splats are
    a run's, or lie in its export folder, each operation is told in dB of the run's photographs.
    """
    from splatcli.commands import edit as work

    work.edit(source, target, typed_in(ctx), dry_run, quiet, as_json)


def verify(
    target: Annotated[
        Path | None,
        typer.Argument(
            help="Splat file, or a run folder for all its files; by default the run here."
        ),
    ] = None,
    against: Annotated[
        Path | None,
        typer.Option(
            help="Run folder or splat file that it must equal; by default the run around it."
        ),
    ] = None,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> None:
    """Prove a file: read it with a second parser, draw it, compare it with what was trained.

    A file outside a run, without --against, is compared with itself: two parsers that share no
    code must read the same. Exit status 7 if a file is wrong.
    """
    from splatcli.commands import verify as work

    work.verify(target, against, quiet, as_json)


def cameras(
    source: Annotated[
        Path, typer.Argument(help="Run folder, transforms.json, or folder with a COLMAP model.")
    ],
    out: Annotated[
        Path, typer.Argument(help="A .json name for nerfstudio, or a folder for COLMAP.")
    ],
    as_json: AsJson = False,
) -> None:
    """Write cameras for other programs: those of a run, of nerfstudio or of COLMAP.

    A run's cameras belong to its undistorted photographs, which the file names; sparse points go
    with them. nerfstudio's world is z up, COLMAP's is ours: y down.
    """
    from splatcli.commands import cameras as work

    work.convert(source, out, as_json)


def doctor(as_json: AsJson = False) -> None:
    """Check what this machine has, and what is missing."""
    from splatcli.commands import doctor as work

    raise typer.Exit(work.show(as_json))


def _register() -> None:
    example = _example("splat process photos/ --preset preview --out run/")
    command = with_parameters(process, commands_process.process_parameters())
    app.command("process", epilog=example)(guarded(command))
    many = with_parameters(batch, commands_process.batch_parameters())
    app.command("batch", epilog=_example("splat batch captures/* --out runs/"))(guarded(many))
    for name in STAGE_NAMES:
        line = _STAGE_EXAMPLES.get(name, f"splat {name}")
        command = with_parameters(_stage_command(name), commands_process.stage_parameters(name))
        app.command(name, help=_STAGE_HELP[name], epilog=_example(line))(guarded(command))
    line = "splat edit scene.ply chair.sog --crop box:-1,-1,-1,1,1,1 --decimate 50%"
    command = with_parameters(edit, chain_parameters())
    app.command("edit", cls=Chain, epilog=_example(line))(guarded(command))
    for extra, line in (
        (status, "splat status run/"),
        (render, "splat render run/ --path orbit --out film.mp4"),
        (view, "splat view run/"),
        (info, "splat info run/7-export/scene.ply"),
        (tradeoff, "splat tradeoff run/"),
        (compare, "splat compare run/ other-run/"),
        (convert, "splat convert scene.ply scene.sog"),
        (verify, "splat verify run/7-export/scene.glb"),
        (cameras, "splat cameras run/ transforms.json"),
        (doctor, "splat doctor"),
    ):
        app.command(extra.__name__, epilog=_example(line))(guarded(extra))


_register()


def main() -> None:
    """Entry point of the `splat` command."""
    app()
