"""The cameras of a rendering: one view's camera, or one camera for each frame of a path."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stages.base.errors import UsageError
from stages.base.text import counted
from stages.cameras.camera_formats import read_cameras
from stages.raster.similarity import Similarity
from stages.scene import Camera, Splats, View
from stages.scene.framing import first_camera
from stages.seed.worlds import FEWEST_SHARED, cameras_of_one_name, similarity_between
from stages.viewer import camera_paths, orbit

_TURN_S = 8.0  # the default duration of one turn around the scene
_SHORTEST_S, _LONGEST_S = 4.0, 40.0  # default durations of other paths
# Standard deviation of the smoothing of hand-held cameras, in the path's default duration: a film
# of few frames goes the same way.
_SMOOTHING_S = 0.3
_SAME_WORLD = 1e-3  # radians, and parts of the cameras' extent: less is the rounding of a file


@dataclass(frozen=True)
class Duration:
    """How long a path lasts: `frames`, or else `seconds`, or else the path's default."""

    frames: int | None = None
    seconds: float | None = None
    frames_per_second: float = 30.0

    @property
    def is_default(self) -> bool:
        return self.frames is None and self.seconds is None

    def frames_or(self, default_s: float) -> int:
        """The number of frames. default_s: the path's default duration, seconds."""
        seconds = default_s if self.seconds is None else self.seconds
        return self.frames or max(1, round(seconds * self.frames_per_second))


@dataclass(frozen=True)
class CameraPath:
    """cameras: one for each frame. keeps_size: whether the cameras' picture sizes come from a
    camera file. notes: sentences for the user."""

    cameras: list[Camera]
    keeps_size: bool = False
    notes: tuple[str, ...] = ()


def camera_of_view(splats: Splats, views: Sequence[View], name: str | None) -> Camera:
    """The camera of a view.

    Args:
        views: sorted by name; may be empty.
        name: the view's name, the last part of its name, or its number; None for the first view,
            or for the first camera of the splats if there are no views.

    Raises SplatError "render-camera".
    """
    if name is None:
        return views[0].camera if views else first_camera(splats)
    for candidates in (
        [view.camera for view in views if view.name == name],
        [view.camera for view in views if view.name.rpartition("/")[2] == name],
    ):
        if len(candidates) == 1:
            return candidates[0]
    if name.isdecimal() and int(name) < len(views):
        return views[int(name)].camera
    wanted = "No --camera: a file has none of its photographs' cameras."
    if views:
        numbers = f"a number from 0 to {len(views) - 1}"
        wanted = f"A photograph's name, or {numbers} ({views[0].name} ... {views[-1].name})."
    raise UsageError(
        "render-camera",
        given=f"There is no camera {name}.",
        wanted=wanted,
        hint="Leave --camera away, or name a run folder whose photographs you want to see.",
    )


def path_cameras(
    path: str, splats: Splats, views: Sequence[View], duration: Duration
) -> CameraPath:
    """The cameras along a path.

    Args:
        path: "orbit", "capture" (past the views' cameras), or a camera file: its cameras, or a
            smooth path through them if a duration is given. Where at least three of them have the
            names of views, all are brought from their world into that of the views.

    Raises SplatError (render-no-capture, render-path, and what reading a camera file raises).
    """
    cameras = [view.camera for view in views]
    if path == "orbit":
        return _orbit(cameras, splats, duration)
    if path == "capture":
        return CameraPath(_past_views(cameras, splats, duration))
    cameras, notes = _read_cameras(path, views)
    cameras = [splats.local(camera) for camera in cameras]
    if not duration.is_default:
        cameras = _interpolated(cameras, splats, duration)
    return CameraPath(cameras, True, notes)


def _orbit(cameras: list[Camera], splats: Splats, duration: Duration) -> CameraPath:
    cameras = cameras or [first_camera(splats)]
    half = orbit.arc_seen(cameras, splats)[1]
    notes: tuple[str, ...] = ()
    if half < math.pi:
        notes = (
            f"The photographs see {2 * math.degrees(half):.0f} degrees of the turn: the path goes "
            "to and fro there.",
        )
    # Going to and fro is fastest in the middle of the arc: at most as fast as a turn.
    default_s = _TURN_S * (1.0 if half >= math.pi else max(1.0, half))
    made = orbit.orbit(cameras, splats, duration.frames_or(default_s))
    return CameraPath(list(made), notes=notes)


def _past_views(cameras: list[Camera], splats: Splats, duration: Duration) -> list[Camera]:
    if not cameras:
        raise UsageError(
            "render-no-capture",
            given="--path capture needs the photographs' cameras, and there are none.",
            wanted="A run folder in which `sfm` has finished, or a file in its 7-export.",
            hint="Name the run folder, or choose --path orbit.",
        )
    cameras = [cameras[i] for i in camera_paths.tour(cameras, splats)]
    path = _interpolated(cameras, splats, duration)
    smoothing = len(path) * _SMOOTHING_S / _default_s(cameras, splats)
    smooth = camera_paths.smoothed_path(path, smoothing)
    return [camera_paths.levelled(camera) for camera in smooth]


def _interpolated(cameras: list[Camera], splats: Splats, duration: Duration) -> list[Camera]:
    frames = duration.frames_or(_default_s(cameras, splats))
    return list(camera_paths.interpolated(cameras, splats, frames))


def _default_s(cameras: list[Camera], splats: Splats) -> float:
    """The default duration of a path through the cameras, seconds."""
    turns = camera_paths.length_in_turns(cameras, splats)
    return min(max(_TURN_S * turns, _SHORTEST_S), _LONGEST_S)


def _read_cameras(path: str, views: Sequence[View]) -> tuple[list[Camera], tuple[str, ...]]:
    """(the cameras of a file in the world of `views`, notes). Raises SplatError."""
    if not Path(path).exists():
        raise UsageError(
            "render-path",
            given=f"--path {path} is neither a known path nor a file.",
            wanted="orbit, capture, a transforms.json or a folder with a COLMAP model.",
            hint="Leave --path away to go around the scene once.",
        )
    found = read_cameras(Path(path))
    cameras = [view.camera for view in found.views]
    notes: list[str] = []
    if found.distorted:
        notes.append(
            f"Warning: in {path} are {counted(found.distorted, 'camera')} whose lens distorts; "
            "the pictures are drawn as pinhole cameras see them."
        )
    world = _world_of(found.views, views)
    if world is not None:
        cameras = [world.apply_to_camera(camera) for camera in cameras]
        notes.append(
            f"{path} is in another world than the run. Its cameras were moved, turned and scaled "
            "so that those of the same photographs agree."
        )
    return cameras, tuple(notes)


def _world_of(there: Sequence[View], here: Sequence[View]) -> Similarity | None:
    """The similarity that takes the cameras of a file to those of the run with the same names; None
    where it changes nothing, or too few names are the same to know it."""
    for folders in (True, False):
        pairs = cameras_of_one_name(there, here, folders)
        if len(pairs) < FEWEST_SHARED:
            continue
        old = np.array([camera.centre for camera, _ in pairs])
        extent = float(np.ptp(old, axis=0).max())
        if not extent:
            return None
        world = similarity_between(pairs)
        moved = world.scale * old @ world.rotation.T + world.offset
        turned = np.abs(world.rotation - np.eye(3)).max()
        if turned < _SAME_WORLD and np.abs(moved - old).max() < _SAME_WORLD * extent:
            return None
        return world
    return None
