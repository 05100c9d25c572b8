"""`splat view`: a page on this machine that shows splats."""

from __future__ import annotations

import re
import signal
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Annotated, Any

import typer

from splatcli import console
from splatcli.arguments import RunOrFile
from splatcli.folders import load_target
from splatcli.options import number
from stages.base import interrupt, scratch
from stages.base.atomic import partial_prefix, remove_abandoned_files
from stages.base.errors import SplatError, UsageError
from stages.base.text import counted
from stages.editing.regions import parse_numbers
from stages.formats import format_of, html, ply, units_of
from stages.formats.replacement import check_target
from stages.formats.values import drop_undrawable
from stages.page.sizes import blurred
from stages.run import results
from stages.run.pipeline import Pipeline
from stages.scene import Splats
from stages.viewer.render_cameras import camera_of_view
from stages.viewer.server import Item, LocalServer, Response, open_in_browser
from stages.viewer.site import site

_BLURRED = "view-blurred"


def _of_page(help: str, shown: str | bool = True, metavar: str | None = None) -> Any:
    """An option of the page for a client."""
    panel = "A page for a client"
    return typer.Option(help=help, show_default=shown, metavar=metavar, rich_help_panel=panel)


def view(
    target: RunOrFile = None,
    *,
    port: Annotated[
        int, number("--port", int, 0, 65535, "Port to serve on; 0 for any that is free.")
    ] = 0,
    open_browser: Annotated[
        bool, typer.Option("--open/--no-open", help="Open the browser, or only print the address.")
    ] = True,
    save: Annotated[
        Path | None,
        _of_page(
            "Write a page for a client (.html), in place of showing one: no panel, no file names; "
            "it opens from disk.",
            metavar="PATH",
        ),
    ] = None,
    camera: Annotated[
        str | None, _of_page("The first view: a photograph's name or number.", "the first")
    ] = None,
    title: Annotated[str | None, _of_page("The page's title.", "the file's name")] = None,
    background: Annotated[
        str | None, _of_page("The colour behind the splats.", "#000000", metavar="#RRGGBB")
    ] = None,
) -> None:
    """Show the splats in a browser: orbit, fly, stand where the photographs were taken.

    The page is served to this machine only and needs no network. Ctrl-C ends it.
    """
    if save is not None:
        _save(target, save, camera, title, background or "#000000")
        return
    if not (camera is None and title is None and background is None):
        raise UsageError(
            "option-alone",
            given="--camera, --title and --background mean nothing without --save.",
            wanted="A page that is written.",
            hint="Add --save PAGE.html, or leave them out.",
        )
    remove_abandoned_files(Path(tempfile.gettempdir()))  # of a view that was killed
    with (
        one_signal_stops(),
        tempfile.TemporaryDirectory(prefix=partial_prefix() + "view-") as folder,
    ):
        with scratch.scratch_in(Path(folder), spare=True):
            splats, pipeline = _loaded(target)
            count = len(splats)
            items = _items(target, pipeline, splats, Path(folder) / "scene.ply")
        del splats  # frees the memory: the page holds what it needs
        with _server(items, port) as server:
            _serve(server, count, open_browser)


def _server(items: dict[str, Item | Response], port: int) -> LocalServer:
    try:
        return LocalServer(items, port)
    except OSError as error:
        raise UsageError(
            "view-port",
            given=f"Port {port} of this machine cannot be listened on: {error.strerror}.",
            wanted="A port that is free and allowed.",
            hint="Leave --port away to get a free one.",
        ) from error


def _loaded(target: Path | None) -> tuple[Splats, Pipeline | None]:
    """As `load_target`, without what cannot be drawn. Warns of what the page cannot show. Raises
    SplatError."""
    splats, pipeline = load_target(target)
    splats, _ = drop_undrawable(splats)
    if not len(splats):
        raise SplatError(
            "view-empty",
            given=f"{_title(target, pipeline)} holds no splat that can be drawn.",
            wanted="At least one.",
            hint="See what it holds with `splat info`.",
        )
    if text := blurred(splats):
        console.warn(f"Warning: {text} ({_BLURRED})")
    return splats, pipeline


def _save(
    target: Path | None, path: Path, camera: str | None, title: str | None, background: str
) -> None:
    """Write the page for a client."""
    if path.suffix.lower() != ".html" or not re.fullmatch("#[0-9a-fA-F]{6}", background):
        raise UsageError(
            "view-page",
            given=f"--save {path} --background {background}.",
            wanted="A name that ends in .html, and a colour such as #ffffff.",
            hint="splat view --save client.html --background '#ffffff'",
        )
    check_target(path, False, target if target is not None and target.is_file() else None)
    if path.name.lower() == "lod-meta.html" and path.with_suffix(".json").exists():
        raise UsageError(
            "view-page",
            given=f"--save {path}: that page belongs to the lod-meta.json beside it.",
            wanted="Another name.",
            hint="splat view --save client.html",
        )
    splats, pipeline = _loaded(target)
    first = camera_of_view(splats, results.views_of(pipeline or results.run_around(target)), camera)
    page = html.ClientPage(first, path.stem if title is None else title, background)
    html.write(path, splats, units=_units(target, pipeline), client=page)
    size = path.stat().st_size
    if console.mode.as_json:
        console.emit("saved", out=str(path), splats=len(splats), size_bytes=size)
    else:
        console.note(f"{path}: {counted(len(splats), 'splat')}, {console.size(size)}.")


def _units(target: Path | None, pipeline: Pipeline | None) -> str:
    """Those that the file says, or the capture of a run."""
    if pipeline is None and target is not None:
        return units_of(target)
    if pipeline is None or pipeline.manifest("sfm") is None:
        return "arbitrary"
    return results.reconstruction_of(pipeline).units


def _items(
    target: Path | None, pipeline: Pipeline | None, splats: Splats, content: Path
) -> dict[str, Item | Response]:
    """The items to serve. The splats are written to `content` as .ply, which the page reads best;
    a lod-meta.json is served as it is."""
    run = pipeline or results.run_around(target)
    capture = None
    if run is not None and run.manifest("sfm") is not None:
        capture = results.reconstruction_of(run)
    units = _units(target, pipeline)
    row = format_of(target) if pipeline is None and target is not None else None
    if target is not None and row is not None and row.streamed and row.takes_views:
        content = target
    else:
        ply.write(content, splats, units=units)
    views, photos = (capture.views, capture.folder) if capture else ((), None)
    source = str(pipeline.run_folder if pipeline is not None else target)
    items = site(_title(target, pipeline), splats, content, views, photos, units, source)
    return {**items, "/point": _print_point}


def _print_point(query: dict[str, str]) -> Item:
    """Print where the page was clicked, and the box around all clicks as options of other commands.
    query: "at", three numbers, and perhaps "box", six."""
    at, box = parse_numbers(query["at"], 3), parse_numbers(query.get("box", "0,0,0,0,0,0"), 6)
    if at is None or box is None:
        raise ValueError("wanted numbers")
    point, ends = at.tolist(), box.tolist() if "box" in query else None
    if console.mode.as_json:
        console.emit("point", at=point, box=ends)
        return Item(b"", "text/plain")
    console.out.print("x,y,z = {:g},{:g},{:g}".format(*point))
    if ends:
        console.out.print("  --crop box:{:g},{:g},{:g},{:g},{:g},{:g}".format(*ends))
    return Item(b"", "text/plain")


def _title(target: Path | None, pipeline: Pipeline | None) -> str:
    path = pipeline.run_folder if pipeline is not None else target or Path()
    return path.absolute().name


def _serve(server: LocalServer, count: int, open_browser: bool) -> None:
    try:
        if console.mode.as_json:
            console.emit("view", address=server.address, splats=count)
        else:
            console.out.print(server.address)
            console.note(f"{counted(count, 'splat')}. Ctrl-C ends it.")
        if open_browser and not open_in_browser(server.address):
            console.note("No browser could be opened; open the address yourself.")
        server.serve_forever()
    except KeyboardInterrupt:
        console.note("Ended.")


@contextmanager
def one_signal_stops() -> Iterator[None]:
    """Handle the end of the terminal or of the session as Ctrl-C, and ignore what follows the first
    signal, so that the temporary folder is removed. Signals that are ignored already stay so."""
    possible = interrupt.signals("SIGINT", "SIGTERM", "SIGHUP")
    handled = [one for one in possible if signal.getsignal(one) != signal.SIG_IGN]

    def stop(received: int, frame: FrameType | None) -> None:
        for one in handled:
            signal.signal(one, signal.SIG_IGN)
        raise KeyboardInterrupt

    with interrupt.handling(handled, stop):
        yield
