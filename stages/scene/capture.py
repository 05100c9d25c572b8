"""Photographs, the capture that they form, and the reconstruction found from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from stages.scene.camera import Camera
from stages.scene.light import Light

Item = TypeVar("Item")
HELD_OUT_EVERY = 8
PHOTOS_FOLDER = "photos/"  # of a capture: where its normalised pictures are
IGNORE, TRANSPARENT = "ignore", "transparent"  # what masks may mean


@dataclass(frozen=True)
class Photo:
    """One usable photograph, as ingest left it.

    name: the user's own relative path, posix style ("day 1/IMG_01.HEIC").
    image: the normalised picture (upright, sRGB, 8 bit), relative to the capture's folder.
    width, height: of the normalised picture, pixels.
    focal_px: focal length from EXIF in pixels of the normalised picture, or None.
    camera: a key that is equal for photographs of the same camera, lens setting and size.
    sharpness: the higher the sharper; comparable within one capture.
    duplicate_of: the first photograph of those that show nearly the same as this one; "" if none
    does.
    log2_luminance: log2 of the median linear luminance. exposure_ev: EV at ISO 100 from EXIF.
    mask: a grey picture of the same size, relative to the capture's folder; "" for none. 0 is
        outside. outside: what that means: IGNORE (nobody knows what is there) or TRANSPARENT
        (nothing is there; `image` is over black, and the mask says how much of it is solid).
    gps: latitude and longitude in degrees from EXIF, or None.
    """

    name: str
    image: str
    width: int
    height: int
    focal_px: float | None
    camera: str
    sharpness: float
    log2_luminance: float
    exposure_ev: float | None
    duplicate_of: str = ""
    mask: str = ""
    outside: str = ""
    gps: tuple[float, float] | None = None

    @property
    def picture(self) -> str:
        """What every later picture of this photograph is called too, with its suffix: decided once,
        by ingest, so that no two photographs share one ("day 1/IMG_01.jpg")."""
        return self.image.removeprefix(PHOTOS_FOLDER)


@dataclass(frozen=True)
class Capture:
    """The usable photographs of one folder. folder: where `Photo.image` paths start."""

    folder: Path
    photos: tuple[Photo, ...]


@dataclass(frozen=True)
class View:
    """A registered photograph, undistorted. image: relative to the reconstruction's folder.
    duplicate_of: as in `Photo`. role: "train" or "test" where a benchmark says so; "" where nobody
    does. mask,
    outside: as in `Photo`, the mask relative to the reconstruction's folder. light: see
    `scene.light`; None where it could not be measured."""

    name: str
    image: str
    camera: Camera
    duplicate_of: str = ""
    role: str = ""
    mask: str = ""
    outside: str = ""
    light: Light | None = None


@dataclass(frozen=True)
class Reconstruction:
    """Posed pinhole views and a sparse cloud, in the levelled and recentred world.

    points [P, 3] float64, colours [P, 3] uint8, errors_px [P] mean reprojection error, tracks [P]
    number of photographs that see the point.
    origin [3]: what to add to be back in the coordinates that `units` speaks of (float64).
    units: "metres", or "arbitrary" where nothing says how large the scene is.
    levelled: whether up = -Y was found from the cameras.
    """

    folder: Path
    views: tuple[View, ...]
    points: NDArray[np.float64]
    colours: NDArray[np.uint8]
    errors_px: NDArray[np.float64]
    tracks: NDArray[np.int32]
    origin: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    units: str = "arbitrary"
    levelled: bool = False


def split_held_out(views: tuple[View, ...]) -> tuple[tuple[View, ...], tuple[View, ...]]:
    """(training, held out): of every eight by name the first is held out, to judge and for nothing
    else. Where views have roles, those for "test" are.

    A photograph that has a duplicate_of would be judged by how well its duplicate_of was learnt:
    the first of the eight that has none takes its place. Fewer than 4 views are too few to spare
    one: then nothing is held out.
    """
    ordered = tuple(sorted(views, key=lambda view: view.name))
    if any(view.role for view in ordered):
        judges = tuple(view for view in ordered if view.role == "test")
        return tuple(view for view in ordered if view.role != "test"), judges
    if len(ordered) < 4:
        return ordered, ()
    eights = (ordered[i : i + HELD_OUT_EVERY] for i in range(0, len(ordered), HELD_OUT_EVERY))
    alone = ([view for view in eight if not view.duplicate_of] for eight in eights)
    held = tuple(eight[0] for eight in alone if eight)
    names = {view.name for view in held}
    return tuple(view for view in ordered if view.name not in names), held


def evenly_spaced(items: Sequence[Item], most: int) -> list[Item]:
    """At most so many of them, evenly: photographs next to each other say the same."""
    count = min(most, len(items))
    return [items[i * len(items) // count] for i in range(count)]


def scene_extent(views: tuple[View, ...]) -> float:
    """The reference trainer's scale of a scene: 1.1 x the largest distance of a camera from the
    cameras' centre, with the median taken as centre and the 95th percentile as "largest" so that
    one stray camera does not set it: the percentile is a camera's own distance, not a mean of two,
    which the stray one could be among. Never 0."""
    centres = np.array([view.camera.centre for view in views])
    distances = np.linalg.norm(centres - np.median(centres, axis=0), axis=1)
    return max(1.1 * float(np.percentile(distances, 95, method="lower")), 1e-6)


def training_extent(reconstruction: Reconstruction) -> float:
    """What training measures strides and sizes by, world units: `scene_extent`, or how far away the
    median camera sees its median point, if that is more. Cameras close together, of a phone held
    almost still, tell little about the size of what is before them."""
    depths = []
    for view in reconstruction.views:
        pixels, z = view.camera.project(reconstruction.points)
        seen = z[(z > 0) & view.camera.shows(pixels)]
        if len(seen):
            depths.append(float(np.median(seen)))
    return max(scene_extent(reconstruction.views), float(np.median(depths)) if depths else 0.0)
