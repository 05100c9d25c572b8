"""Where to draw from: one of the photographs' cameras, or a path."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from splatcli import console
from stages.base.errors import Family, SplatError
from stages.base.text import counted
from stages.run.pipeline import Pipeline

if TYPE_CHECKING:
    from stages.scene import Camera, Splats, View

_TURN_S = 8.0  # one turn around the scene, unhurried
_SHORTEST_S, _LONGEST_S = 4.0, 40.0  # of a path that is not asked to last so long
_STEADY_S = 0.3  # over which a film of hand-held photographs is smoothed
Length = tuple[int | None, float | None, float]  # frames, seconds, frames a second


def views_of(pipeline: Pipeline | None) -> tuple[View, ...]:
    """The capture's cameras by name; none without a finished reconstruction."""
    if pipeline is None or pipeline.manifest("sfm") is None:
        return ()
    return tuple(sorted(pipeline.load("sfm").views, key=lambda view: view.name))


def one_camera(splats: Splats, views: Sequence[View], wanted: str | None) -> Camera:
    """The camera of a photograph by name or number; the first, or one in front of the splats, if
    none is named. Raises SplatError "render-camera"."""
    from stages.scene.framing import front_camera

    if wanted is None:
        return views[0].camera if views else front_camera(splats)
    by_name = {view.name: view.camera for view in views}
    if wanted in by_name:
        return by_name[wanted]
    alike = [view.camera for view in views if view.name.rpartition("/")[2] == wanted]
    if len(alike) == 1:
        return alike[0]
    if wanted.isdigit() and int(wanted) < len(views):
        return views[int(wanted)].camera
    known = f"{views[0].name} ... {views[-1].name}" if views else "none: a file has no cameras"
    raise SplatError(
        "render-camera",
        given=f"There is no camera {wanted}.",
        wanted=f"A photograph's name, or a number from 0 to {max(0, len(views) - 1)} ({known}).",
        hint="Leave --camera away, or name a run folder whose photographs you want to see.",
        family=Family.USAGE,
    )


def along(
    path: str, splats: Splats, views: Sequence[View], length: Length
) -> tuple[list[Camera], bool]:
    """(a camera a frame, whether their sizes are a camera file's own).

    path: "orbit", "capture", or a camera file: its cameras as they are, or a smooth path through
    them if a length is given. Raises SplatError.
    """
    from stages.scene.framing import front_camera
    from stages.viewer import camera_paths, orbit

    cameras = [view.camera for view in views]
    if path == "orbit":
        cameras = cameras or [front_camera(splats)]
        half = orbit.arc_seen(cameras, splats)[1]
        if half < math.pi:
            _tell_swing(2 * math.degrees(half))
        # To and fro is fastest in the middle: no faster there than a turn.
        usual = _TURN_S * (1.0 if half >= math.pi else max(1.0, half))
        return list(orbit.orbit(cameras, splats, _frames(length, usual))), False
    if path == "capture":
        if not cameras:
            raise SplatError(
                "render-no-capture",
                given="--path capture needs the photographs' cameras, and there are none.",
                wanted="A run folder in which `sfm` has finished, or a file in its 7-export.",
                hint="Name the run folder, or choose --path orbit.",
                family=Family.USAGE,
            )
        cameras = [cameras[i] for i in camera_paths.tour(cameras, splats)]
        steady = camera_paths.smoothed(_travel(cameras, splats, length), _STEADY_S * length[2])
        return [camera_paths.levelled(camera) for camera in steady], False
    cameras = _from_file(path)
    if length[0] is None and length[1] is None:
        return cameras, True
    return _travel(cameras, splats, length), True


def _travel(cameras: list[Camera], splats: Splats, length: Length) -> list[Camera]:
    from stages.viewer import camera_paths

    usual = _TURN_S * camera_paths.length_in_turns(cameras, splats)
    frames = _frames(length, min(max(usual, _SHORTEST_S), _LONGEST_S))
    return list(camera_paths.interpolated(cameras, splats, frames))


def _frames(length: Length, usual_s: float) -> int:
    frames, seconds, fps = length
    return frames or max(1, round((usual_s if seconds is None else seconds) * fps))


def _from_file(path: str) -> list[Camera]:
    from stages.cameras.table import read_cameras

    if not Path(path).exists():
        raise SplatError(
            "render-path",
            given=f"--path {path} is neither a known path nor a file.",
            wanted="orbit, capture, a transforms.json or a folder with a COLMAP model.",
            hint="Leave --path away to go around the scene once.",
            family=Family.USAGE,
        )
    found = read_cameras(Path(path))
    if found.distorted:
        console.note(
            f"Warning: in {path} are {counted(found.distorted, 'camera')} whose lens distorts; "
            "the pictures are drawn as pinhole cameras see them.",
            "yellow",
        )
    return [view.camera for view in found.views]


def _tell_swing(seen_deg: float) -> None:
    console.note(
        f"The photographs see {seen_deg:.0f} degrees of the turn: the path goes to and fro there."
    )
