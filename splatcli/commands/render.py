"""`splat render`: a picture, a film or a folder of frames."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from splatcli import console
from splatcli.arguments import Backend, Device, RunOrFile
from splatcli.folders import load_target
from splatcli.options import number
from splatcli.progress import counting
from stages.base import memory
from stages.base.errors import ResourceError, SplatError, UsageError
from stages.raster.backends import AUTO, qualified_name
from stages.raster.definition import Rendering
from stages.raster.draw import renderer, supersampled
from stages.raster.torch_device import CPU
from stages.run import results
from stages.scene import Camera, Splats, View
from stages.viewer import sinks
from stages.viewer.render_cameras import Duration, camera_of_view, path_cameras
from stages.viewer.sinks import frames_beyond

PICTURES = (".png", ".jpg", ".jpeg", ".webp")
_BYTES_PER_PIXEL = 100  # colour and depth planes, their copies, and the tiles' lists
_LARGEST_FILM_SIDE = 1280  # pixels, unless --width or a camera file says otherwise


@dataclass(frozen=True)
class _Options:
    """The options of the command; None where they are not given."""

    out: Path
    camera: str | None
    path: str | None
    frames: int | None
    seconds: float | None
    fps: float
    width: int | None
    depth: bool

    def kind(self) -> str:
        """picture, film or folder, by the name of `out`. Raises SplatError for options that do not
        go together."""
        out = self.out
        suffix = out.suffix.lower()
        if suffix in PICTURES and not out.is_dir():
            path = {"--path": self.path, "--frames": self.frames, "--seconds": self.seconds}
            given = [name for name, value in path.items() if value is not None]
            if given:
                raise _clash(f"{given[0]} makes many pictures, and {out} holds one.", "film.mp4")
            return "picture"
        if self.camera is not None and (suffix == ".mp4" or not suffix or out.is_dir()):
            raise _clash(f"--camera makes one picture, and {out} is for many.", "view.png")
        if self.frames is not None and self.seconds is not None:
            raise UsageError(
                "render-length",
                given=f"--frames {self.frames} and --seconds {self.seconds:g}.",
                wanted="One of them: the other follows from --fps.",
                hint="Leave one of them away.",
            )
        if suffix == ".mp4" and not out.is_dir():
            return "film"
        if out.is_dir() or (not suffix and not out.exists()):
            return "folder"
        raise UsageError(
            "render-picture-type",
            given=f"{out} cannot hold a rendering.",
            wanted=f"A name that ends in one of {' '.join((*PICTURES, '.mp4'))}, or a folder's.",
            hint="For example --out view.png, --out film.mp4 or --out frames",
        )


def render(
    target: RunOrFile = None,
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
) -> None:
    """Draw the splats: from a photograph's camera, or as a film along a path.

    Frames that are in the folder already are written again. Depth is z in world units, 0 where
    there is nothing; in films near is light and far is dark. Pictures smaller than those of
    training are drawn larger and averaged.
    """
    options = _Options(out, camera, path, frames, seconds, fps, width, depth)
    kind = options.kind()
    facts = _render(target, options, kind, backend, device)
    if kind == "folder" and not console.mode.quiet:
        _warn_of_other_frames(out, facts["frames"])
    if console.mode.as_json:
        console.emit("rendered", out=str(out), kind=kind, **facts)
    else:
        _print(out, kind, facts)


def _render(
    target: Path | None, options: _Options, kind: str, backend: str | None, device: str | None
) -> dict[str, Any]:
    """Draw and write the pictures. Returns figures: frames, size, depth range, times."""
    begun = time.monotonic()
    splats, pipeline = load_target(target)
    run = pipeline or results.run_around(target)
    cameras = _cameras(splats, results.views_of(run), options, kind)
    _check_memory(max(cameras, key=lambda camera: camera.width * camera.height))
    console.note_compiling()
    backend = (
        qualified_name(backend or AUTO, device or CPU)
        if backend or device
        else results.backend_of_run(run)
    )
    draw = supersampled(renderer(splats, backend=backend), splats.draw_settings.side)
    sink, facts = _sink(options, kind, draw, cameras)
    rate = _draw_all(draw, cameras, sink)
    facts |= {"frames": len(cameras), "width": cameras[0].width, "height": cameras[0].height}
    if rate is not None:
        facts["frames_a_second"] = round(rate, 2)
    return facts | {"splats": len(splats), "seconds": round(time.monotonic() - begun, 2)}


def _cameras(splats: Splats, views: tuple[View, ...], options: _Options, kind: str) -> list[Camera]:
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
    free = memory.available_mib()
    needed = camera.width * camera.height * _BYTES_PER_PIXEL / memory.MIB
    if needed > free:
        raise ResourceError(
            "render-too-large",
            given=f"A picture of {camera.width} x {camera.height} takes about {needed:,.0f} MiB.",
            wanted=f"At most the {free:,.0f} MiB that are free.",
            hint="Choose a smaller --width.",
        )


def _sink(
    options: _Options, kind: str, draw: Callable[[Camera], Rendering], cameras: list[Camera]
) -> tuple[AbstractContextManager[Callable[[Rendering], None]], dict[str, Any]]:
    """(what writes the renderings, the depth range of a film with depth)."""
    if kind == "folder":
        return sinks.folder_sink(options.out, len(cameras), options.depth), {}
    if kind == "picture":
        return nullcontext(partial(sinks.save_rendering, options.out, options.depth)), {}
    near_far = sinks.sampled_range(draw, cameras) if options.depth else None
    size = cameras[0].width, cameras[0].height
    facts = {"depth_near": near_far[0], "depth_far": near_far[1]} if near_far else {}
    return sinks.film_sink(options.out, *size, options.fps, near_far), facts


def _draw_all(
    draw: Callable[[Camera], Rendering],
    cameras: list[Camera],
    sink: AbstractContextManager[Callable[[Rendering], None]],
) -> float | None:
    """Draw and write all frames. Returns frames a second without the writing, from the second frame
    on, because the first also compiles kernels and makes buffers; None for a single frame."""
    seconds = []
    with counting("frames", len(cameras)) as tick, sink as put:
        for camera in cameras:
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
    console.note(f"{out}: {many}{size}, {facts['splats']:,} splats{rate}")
    if "depth_near" in facts:
        ends = f"{facts['depth_near']:.3g} to {facts['depth_far']:.3g}"
        console.note(f"Depth, light to dark: {ends} world units")


def _clash(given: str, example: str) -> SplatError:
    return UsageError(
        "render-one-or-many",
        given=given,
        wanted="One picture of one camera, or many along a path.",
        hint=f"For example --out {example}",
    )
