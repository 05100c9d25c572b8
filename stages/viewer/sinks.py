"""Sinks: they receive renderings one after another and write pictures or films."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

from stages.base.atomic import make_folder
from stages.raster.definition import Rendering
from stages.scene import Camera
from stages.viewer.film_file import film
from stages.viewer.image_files import (
    depth_colours,
    depth_range,
    eight_bits,
    save_depth,
    save_picture,
)

_SAMPLED = 12  # frames of a path that determine its depth range
_SAMPLED_SIDE = 240  # pixels

Put = Callable[[Rendering], None]


@contextmanager
def picture_sink(path: Path, depth: bool) -> Iterator[Put]:
    """Writes the picture `path`; with `depth` also its depth as .depth.tiff. Raises SplatError."""

    def put(rendering: Rendering) -> None:
        save_picture(path, eight_bits(rendering.image))
        if depth:
            save_depth(path.with_suffix(".depth.tiff"), rendering.median_depth)

    yield put


@contextmanager
def folder_sink(folder: Path, frames: int, depth: bool) -> Iterator[Put]:
    """Writes frame_0001.png and so on into `folder`, which is made; existing frames are replaced.
    With `depth` also frame_0001.depth.tiff. Raises SplatError."""
    make_folder(folder)
    number = 0

    def put(rendering: Rendering) -> None:
        nonlocal number
        number += 1
        path = folder / f"frame_{number:0{max(4, len(str(frames)))}}.png"
        save_picture(path, eight_bits(rendering.image))
        if depth:
            save_depth(path.with_suffix(".depth.tiff"), rendering.median_depth)

    yield put


def frames_beyond(folder: Path, frames: int) -> int:
    """The number of frames in `folder` that belong to an earlier, longer path."""
    numbers = (path.stem.removeprefix("frame_") for path in folder.glob("frame_*.png"))
    return sum(number.isdigit() and int(number) > frames for number in numbers)


@contextmanager
def film_sink(
    path: Path, width: int, height: int, fps: float, near_far: tuple[float, float] | None
) -> Iterator[Put]:
    """Writes the film `path`; with a depth range also a film of the depth colours, .depth.mp4. Both
    are written whole at the end. Raises SplatError."""
    with ExitStack() as stack:
        add = stack.enter_context(film(path, width, height, fps))
        add_depth = None
        if near_far is not None:
            beside = path.with_suffix(".depth.mp4")
            add_depth = stack.enter_context(film(beside, width, height, fps))

        def put(rendering: Rendering) -> None:
            add(eight_bits(rendering.image))
            if add_depth is not None and near_far is not None:
                add_depth(depth_colours(rendering.median_depth, *near_far))

        yield put


def sampled_range(
    draw: Callable[[Camera], Rendering], cameras: Sequence[Camera]
) -> tuple[float, float]:
    """(near, far) of a whole path, so that a colour is the same depth in every frame."""
    some = cameras[:: max(1, len(cameras) // _SAMPLED)]
    return depth_range([draw(camera.fitted(_SAMPLED_SIDE)).median_depth for camera in some])
