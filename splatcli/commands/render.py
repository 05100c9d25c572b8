"""`splat render`: a picture, a film or a folder of pictures, drawn along a path."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from splatcli import console, sources, viewpoints
from splatcli.progress import counting
from stages.base import memory
from stages.base.errors import Family, SplatError
from stages.raster.kernels import cache

if TYPE_CHECKING:
    from stages.raster.definition import Rendering
    from stages.scene import Camera

PICTURES = (".png", ".jpg", ".jpeg", ".webp")
_BYTES_PER_PIXEL = 100  # planes of colour and depth, their copies, and what tiles remember
_LARGEST_FILM_SIDE = 1280  # pixels, unless --width or a camera file says otherwise


@dataclass(frozen=True)
class Wanted:
    """What was typed. None: not given."""

    out: Path
    camera: str | None = None
    path: str | None = None
    frames: int | None = None
    seconds: float | None = None
    fps: float = 30.0
    width: int | None = None
    depth: bool = False
    backend: str | None = None
    device: str | None = None
    quiet: bool = False
    as_json: bool = False


def render(target: Path | None, wanted: Wanted) -> None:
    """Draw what was asked for. Raises SplatError."""
    from stages.raster.backends import AUTO, qualified_name
    from stages.raster.draw import renderer
    from stages.raster.torch_device import CPU
    from stages.viewer import sinks

    kind = _kind_of(wanted)
    splats, pipeline = sources.splats_of(target)
    seen = viewpoints.views_of(pipeline or sources.pipeline_around(target))
    begun = time.monotonic()
    if kind == "picture":
        cameras = [_widened(viewpoints.one_camera(splats, seen, wanted.camera), wanted.width)]
    else:
        cameras = _film_cameras(splats, seen, wanted, kind == "film")
    _check_memory(max(cameras, key=lambda camera: camera.width * camera.height))
    if not cache.are_compiled():
        console.note("Compiling the kernels; this is done once and takes about half a minute.")
    backend = sources.backend_of(pipeline or sources.pipeline_around(target))
    if wanted.backend or wanted.device:
        backend = qualified_name(wanted.backend or AUTO, wanted.device or CPU)
    draw = renderer(splats, backend=backend)
    out = wanted.out
    facts: dict[str, Any] = {}
    if kind == "film":
        near_far = sinks.sampled_range(draw, cameras) if wanted.depth else None
        if near_far is not None:
            facts = {"depth_near": near_far[0], "depth_far": near_far[1]}
        sink = sinks.film_sink(out, cameras[0].width, cameras[0].height, wanted.fps, near_far)
    elif kind == "folder":
        sink = sinks.folder_sink(out, len(cameras), wanted.depth)
    else:
        sink = sinks.picture_sink(out, wanted.depth)
    rate = _draw_all(draw, cameras, sink, wanted)
    facts |= {"frames": len(cameras), "width": cameras[0].width, "height": cameras[0].height}
    if rate is not None:
        facts["frames_a_second"] = round(rate, 2)
    facts |= {"splats": len(splats), "seconds": round(time.monotonic() - begun, 2)}
    _tell(wanted, kind, facts)


def _draw_all(
    draw: Callable[[Camera], Rendering],
    cameras: list[Camera],
    sink: AbstractContextManager[Callable[[Rendering], None]],
    wanted: Wanted,
) -> float | None:
    """Frames drawn in a second, writing left out; None for a single one, since the first readies
    kernels and buffers."""
    quiet = wanted.quiet or (len(cameras) == 1 and not wanted.as_json)
    seconds = []
    with counting("frames", len(cameras), quiet, wanted.as_json) as tick, sink as put:
        for camera in cameras:
            begun = time.perf_counter()
            drawn = draw(camera)
            seconds.append(time.perf_counter() - begun)
            put(drawn)
            tick()
    return len(seconds[1:]) / sum(seconds[1:]) if len(seconds) > 1 else None


def _tell(wanted: Wanted, kind: str, facts: dict[str, Any]) -> None:
    if kind == "folder" and not wanted.quiet:
        from stages.viewer.sinks import frames_beyond

        left = frames_beyond(wanted.out, facts["frames"])
        if left:
            console.note(f"Warning: {left} frames of an earlier, longer path are still there.")
    if wanted.as_json:
        console.emit("rendered", out=str(wanted.out), kind=kind, **facts)
        return
    many = f"{facts['frames']} frames, " if kind != "picture" else ""
    size = f"{facts['width']} x {facts['height']}"
    told = facts.get("frames_a_second")
    rate = f", drawn at {told:.3g} frames a second" if told else ""
    console.note(f"{wanted.out}: {many}{size}, {facts['splats']:,} splats{rate}")
    if "depth_near" in facts:
        ends = f"{facts['depth_near']:.3g} to {facts['depth_far']:.3g}"
        console.note(f"Depth, light to dark: {ends} world units")


def _kind_of(wanted: Wanted) -> str:
    """picture, film or folder: by the name to write. Raises SplatError for options that do not go
    with it."""
    out = wanted.out
    suffix = out.suffix.lower()
    if suffix in PICTURES and not out.is_dir():
        moving = {"--path": wanted.path, "--frames": wanted.frames, "--seconds": wanted.seconds}
        given = [name for name, value in moving.items() if value is not None]
        if given:
            raise _clash(f"{given[0]} makes many pictures, and {out} holds one.", "film.mp4")
        return "picture"
    if wanted.camera is not None and (suffix == ".mp4" or not suffix or out.is_dir()):
        raise _clash(f"--camera makes one picture, and {out} is for many.", "view.png")
    if wanted.frames is not None and wanted.seconds is not None:
        raise SplatError(
            "render-length",
            given=f"--frames {wanted.frames} and --seconds {wanted.seconds:g}.",
            wanted="One of them: the other follows from --fps.",
            hint="Leave one of them away.",
            family=Family.USAGE,
        )
    if suffix == ".mp4" and not out.is_dir():
        return "film"
    if out.is_dir() or (not suffix and not out.exists()):
        return "folder"
    raise SplatError(
        "render-picture-type",
        given=f"{out} is to hold what is drawn.",
        wanted=f"A name that ends in one of {' '.join((*PICTURES, '.mp4'))}, or a folder's.",
        hint="For example --out view.png, --out film.mp4 or --out frames",
        family=Family.USAGE,
    )


def _film_cameras(splats: Any, seen: Any, wanted: Wanted, is_film: bool) -> list[Camera]:
    """A camera a frame; for a film, all of one even size."""
    cameras, as_given = viewpoints.along(
        wanted.path or "orbit", splats, seen, (wanted.frames, wanted.seconds, wanted.fps)
    )
    if wanted.width is not None:
        cameras = [_widened(camera, wanted.width) for camera in cameras]
    elif not as_given:
        cameras = [camera.fitted(_LARGEST_FILM_SIDE) for camera in cameras]
    if not is_film:
        return cameras
    width, height = (max(2, 2 * round(n / 2)) for n in (cameras[0].width, cameras[0].height))
    return [camera.reframed(width, height) for camera in cameras]


def _widened(camera: Camera, width: int | None) -> Camera:
    if width is None:
        return camera
    return camera.resized(width, max(1, round(width * camera.height / camera.width)))


def _check_memory(camera: Camera) -> None:
    free = memory.available_mib()
    needed = camera.width * camera.height * _BYTES_PER_PIXEL / memory.MIB
    if free is not None and needed > free:
        raise SplatError(
            "render-too-large",
            given=f"A picture of {camera.width} x {camera.height} takes about {needed:,.0f} MiB.",
            wanted=f"At most the {free:,.0f} MiB that are free.",
            hint="Choose a smaller --width.",
            family=Family.RESOURCES,
        )


def _clash(given: str, example: str) -> SplatError:
    return SplatError(
        "render-one-or-many",
        given=given,
        wanted="One picture of one camera, or many along a path.",
        hint=f"For example --out {example}",
        family=Family.USAGE,
    )
