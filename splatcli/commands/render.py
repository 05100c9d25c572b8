"""`splat render`: a picture, a film or a folder of frames."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from splatcli import console
from splatcli.arguments import Backend, RunOrFile
from splatcli.folders import load_target
from splatcli.options import given_only
from splatcli.progress import counting
from splatcli.render_options import RenderOptions
from stages.base import memory
from stages.base.errors import Interrupted, ResourceError, UsageError
from stages.base.interrupt import stop_on_signals
from stages.base.settings import changed
from stages.base.text import counted
from stages.raster.definition import Rendering
from stages.raster.draw import renderer, supersampled
from stages.run import results
from stages.scene import Camera, Splats, View
from stages.viewer import sinks
from stages.viewer.render_cameras import Duration, camera_of_view, path_cameras
from stages.viewer.sinks import frames_beyond

_BYTES_PER_PIXEL = 100  # colour and depth planes, their copies, and the tiles' lists
_LARGEST_FILM_SIDE = 1280  # pixels, unless --width or a camera file says otherwise
# Pixels. VP8's fields have 14 bits (RFC 6386, 9.1). JPEG's have 16 (ITU-T T.81, B.2.2), and
# libjpeg's limit is a little lower.
_LARGEST_SIDES = {".webp": 16383, ".jpg": 65500, ".jpeg": 65500}


def render(
    target: RunOrFile = None,
    *,
    out: Annotated[
        Path,
        typer.Option(
            "--out", "-o", metavar="PATH", help="Picture (.png), film (.mp4) or folder of frames."
        ),
    ] = Path("view.png"),
    backend: Backend = None,
    **given: Any,
) -> None:
    """Draw the splats: from a photograph's camera, or as a film along a path.

    Frames that are in the folder already are written again. Depth is z in world units of the splat
    at which half of the light is stopped, 0 where less is. Pictures of two thirds of the size in
    training and less are drawn larger and averaged.
    """
    wanted = changed(RenderOptions(), given_only(given))
    kind = wanted.kind(out)
    begun = time.monotonic()
    splats, pipeline = load_target(target)
    run = pipeline or results.run_around(target)
    cameras = _cameras(splats, results.views_of(run), wanted, kind)
    _check_memory(max(cameras, key=lambda camera: camera.width * camera.height))
    if kind == "picture":
        _check_format(out, cameras[0])
    console.note_compiling()
    draw = renderer(splats, backend=backend or results.backend_of_run(run))
    draw = supersampled(draw, splats.draw_settings.side or results.training_side_of(run))
    rate = _draw_all(draw, cameras, _sink(out, wanted, kind, cameras))
    facts: dict[str, Any] = {
        "frames": len(cameras),
        "width": cameras[0].width,
        "height": cameras[0].height,
    }
    facts |= {} if rate is None else {"frames_a_second": round(rate, 2)}
    facts |= {"splats": len(splats), "seconds": round(time.monotonic() - begun, 2)}
    if kind == "folder" and not console.mode.quiet:
        _warn_of_other_frames(out, len(cameras))
    if console.mode.as_json:
        console.emit("rendered", out=str(out), kind=kind, **facts)
    else:
        _print(out, kind, facts)


def _cameras(
    splats: Splats, views: tuple[View, ...], options: RenderOptions, kind: str
) -> list[Camera]:
    """One camera for each frame; for a film, all of one even size. Raises SplatError."""
    if kind == "picture":
        return [_resized(camera_of_view(splats, views, options.camera), options.width)]
    duration = Duration(options.frames, options.seconds, options.fps)
    found = path_cameras(options.path or "orbit", splats, views, duration)
    for text in found.notes:
        console.note(text)
    cameras = [_resized(camera, options.width) for camera in found.cameras]
    if options.width is None and not found.keeps_size:
        cameras = [camera.fitted(_LARGEST_FILM_SIDE) for camera in cameras]
    if kind == "folder":
        return cameras
    width, height = (max(2, 2 * round(n / 2)) for n in (cameras[0].width, cameras[0].height))
    return [camera.reframed(width, height) for camera in cameras]


def _resized(camera: Camera, width: int | None) -> Camera:
    if width is None:
        return camera
    return camera.resized(width, max(1, round(width * camera.height / camera.width)))


def _check_memory(camera: Camera) -> None:
    free = memory.available_mib() * memory.MIB
    needed = camera.width * camera.height * _BYTES_PER_PIXEL
    if needed > free:
        raise ResourceError(
            "render-too-large",
            given=f"A picture of {camera.width} x {camera.height} takes {console.size(needed)}.",
            wanted=f"At most the {console.size(free)} that are free.",
            hint="Choose a smaller --width.",
        )


def _check_format(out: Path, camera: Camera) -> None:
    """Whether the format of `out` holds so large a picture. Raises SplatError."""
    most = _LARGEST_SIDES.get(out.suffix.lower(), math.inf)
    if max(camera.width, camera.height) > most:
        raise UsageError(
            "render-format-size",
            given=f"A picture of {camera.width} x {camera.height}.",
            wanted=f"At most {most:,} pixels a side, the limit of {out.suffix}.",
            hint=f"Choose --out {out.with_suffix('.png').name}, or a smaller --width.",
        )


def _sink(
    out: Path, options: RenderOptions, kind: str, cameras: list[Camera]
) -> AbstractContextManager[Callable[[Rendering], None]]:
    """What writes the renderings."""
    if kind == "folder":
        return sinks.folder_sink(out, len(cameras), options.depth)
    if kind == "picture":
        return nullcontext(partial(sinks.save_rendering, out, options.depth))
    return sinks.film_sink(out, cameras[0].width, cameras[0].height, options.fps)


def _draw_all(
    draw: Callable[[Camera], Rendering],
    cameras: list[Camera],
    sink: AbstractContextManager[Callable[[Rendering], None]],
) -> float | None:
    """Draw and write all frames. Returns frames a second without the writing, from the second frame
    on, because the first also compiles kernels and makes buffers; None for a single frame.

    Raises Interrupted between two frames after Ctrl-C: in a compiled kernel a KeyboardInterrupt may
    come back as another error."""
    seconds: list[float] = []
    stop = threading.Event()
    with (
        stop_on_signals(stop, lambda: None),
        counting("frames", len(cameras)) as tick,
        sink as put,
    ):
        for camera in cameras:
            if stop.is_set():
                raise Interrupted(f"stopped after {len(seconds)} of {len(cameras)} frames")
            begun = time.perf_counter()
            drawn = draw(camera)
            seconds.append(time.perf_counter() - begun)
            put(drawn)
            tick()
    return len(seconds[1:]) / sum(seconds[1:]) if len(seconds) > 1 else None


def _warn_of_other_frames(folder: Path, frames: int) -> None:
    if left := frames_beyond(folder, frames):
        console.note(f"Warning: {left} frames of an earlier, longer path are still there.")


def _print(out: Path, kind: str, facts: dict[str, Any]) -> None:
    many = f"{facts['frames']} frames, " if kind != "picture" else ""
    size = f"{facts['width']} x {facts['height']}"
    rate = ""
    if "frames_a_second" in facts:
        rate = f", drawn at {facts['frames_a_second']:.3g} frames a second"
    console.note(f"{out}: {many}{size}, {counted(facts['splats'], 'splat')}{rate}")
