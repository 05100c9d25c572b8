"""`splat view`: a page on this machine to look at splats with."""

from __future__ import annotations

import os
import signal
import sys
import tempfile
import threading
import webbrowser
from pathlib import Path
from typing import TYPE_CHECKING

from splatcli import console, sources
from stages.base.errors import Family, SplatError
from stages.run.pipeline import Pipeline

if TYPE_CHECKING:
    from stages.scene import Splats
    from stages.viewer.server import Item, LocalServer


def show(target: Path | None, port: int, open_browser: bool) -> None:
    """Serve the page until Ctrl-C. Raises SplatError."""
    from stages.base import scratch
    from stages.formats.values import drop_undrawable
    from stages.viewer.server import LocalServer

    with tempfile.TemporaryDirectory(prefix="splat-view-") as folder:
        with scratch.scratch_in(Path(folder), spare=True):
            splats, pipeline = sources.splats_of(target)
            splats, _ = drop_undrawable(splats)
            count = len(splats)
            if not count:
                raise SplatError(
                    "view-empty",
                    given=f"{_title(target, pipeline)} holds no splat that can be drawn.",
                    wanted="At least one.",
                    hint="See what it holds with `splat info`.",
                )
            items = _items(target, pipeline, splats, Path(folder) / "scene.ply")
        del splats  # the page is made: it need not wait beside them
        try:
            server = LocalServer(items, port)
        except OSError as error:
            raise _port_refused(port, error) from error
        with server:
            _serve(server, count, open_browser)


def _items(
    target: Path | None, pipeline: Pipeline | None, splats: Splats, content: Path
) -> dict[str, Item]:
    """What is served; the splats are written to `content`, as the viewer reads them best. An asset
    that streams is served as it is."""
    from stages.formats import format_of, ply
    from stages.viewer.site import site

    run = pipeline or sources.pipeline_around(target)
    sfm = run.load("sfm") if run is not None and run.manifest("sfm") is not None else None
    units = sfm.units if sfm else "arbitrary"
    if pipeline is None and target is not None and format_of(target).streamed:
        content = target
    else:
        ply.write(content, splats, units=units)
    seen, photos = (sfm.views, sfm.folder) if sfm else ((), None)
    source = str(pipeline.run_folder if pipeline is not None else target)
    return site(_title(target, pipeline), splats, content, seen, photos, units, source)


def _title(target: Path | None, pipeline: Pipeline | None) -> str:
    path = pipeline.run_folder if pipeline is not None else target or Path()
    return path.absolute().name


def _serve(server: LocalServer, count: int, open_browser: bool) -> None:
    try:
        _end_like_ctrl_c()
        console.out.print(server.address)
        console.note(f"{count:,} splats. Ctrl-C ends it.")
        if open_browser and not open_page(server.address):
            console.note("No browser could be opened; open the address yourself.")
        server.serve_forever()
    except KeyboardInterrupt:
        console.note("Ended.")


def open_page(address: str) -> bool:
    """Whether a browser took the address. On a machine without a screen none is tried: one that
    draws in the terminal could show nothing, and would hold it."""
    screen = any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER"))
    if sys.platform.startswith("linux") and not screen:
        return False
    return webbrowser.open(address)


def _end_like_ctrl_c() -> None:
    """A closed terminal too must not leave the temporary folder behind."""
    if threading.current_thread() is threading.main_thread():
        for name in ("SIGTERM", "SIGHUP"):
            if hasattr(signal, name):
                signal.signal(getattr(signal, name), signal.default_int_handler)


def _port_refused(port: int, error: OSError) -> SplatError:
    return SplatError(
        "view-port",
        given=f"Port {port} of this machine cannot be listened on: {error.strerror or error}.",
        wanted="A port that is free and allowed.",
        hint="Leave --port away: then one that is free is taken.",
        family=Family.USAGE,
    )
