"""Photographs, the capture that they form, and the reconstruction found from them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from stages.scene.camera import Camera
from stages.scene.light import Light
from stages.scene.place import EarthPlace

Item = TypeVar("Item")
HELD_OUT_EVERY = 8
PHOTOS_FOLDER = "photos/"  # folder of a capture with its normalised pictures
IGNORE, TRANSPARENT = "ignore", "transparent"  # meaning of pixels outside a mask


@dataclass(frozen=True)
class Face:
    """Where a pinhole picture was cut out of a panorama or of a wide fisheye photograph.

    Args:
        rig: a key that is equal for panoramas of the same camera and size: one COLMAP rig.
        frame: the name of the panorama or photograph: one COLMAP frame of that rig.
        turn: unit quaternion (w, x, y, z) of the rotation from its axes (x right, y down, z towards
            its middle) to those of the pinhole camera.
    """

    rig: str
    frame: str
    turn: tuple[float, float, float, float]


@dataclass(frozen=True)
class Photo:
    """One usable photograph, or one face of a panorama or wide fisheye photograph.

    Args:
        name: the user's own relative path in posix style ("day 1/IMG_01.HEIC"); of a
            face, with its direction ("pano.jpg/072+25").
        image: the normalised picture (upright, sRGB, 8 bit), relative to the capture's folder.
        width, height: of the normalised picture, pixels.
        focal_px: focal length from EXIF in pixels of the normalised picture, or None.
        camera: a key that is equal for photographs of the same camera, lens setting and size.
        sharpness: higher is sharper; comparable within one capture.
        log2_luminance: log2 of the median linear luminance.
        exposure_ev: EV at ISO 100 from EXIF, or None.
        duplicate_of: name of the first photograph that shows nearly the same; "" if none does.
        mask: a grey picture of the same size, relative to the capture's folder; "" for none. 0 is
            outside.
        outside: what pixels outside the mask mean. IGNORE: unknown content, which counts nowhere.
            TRANSPARENT: nothing is there; `image` is composited over black, and the mask is alpha.
        gps: latitude and longitude in degrees from EXIF or XMP, or None.
        gps_height: metres, above sea level or the ellipsoid as the receiver has it, or None.
        depth: a .npy, [h, w] float32 of any size, relative to the capture's folder; "" for none.
            Measured z in metres, 0 where nothing was measured.
        gps_error_m: standard deviation of `gps` as the receiver states it, metres, or None.
        face: of a panorama; None for a photograph. The intrinsics of faces are exact.
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
    gps_height: float | None = None
    gps_error_m: float | None = None
    depth: str = ""
    face: Face | None = None

    @property
    def source(self) -> str:
        """The name of the user's picture: of the panorama, if this is a face."""
        return self.face.frame if self.face else self.name

    @property
    def picture(self) -> str:
        """The file name, with suffix, of this photograph in every later stage ("day 1/IMG_01.jpg").
        Ingest chooses it once and makes sure that no two photographs share one."""
        return self.image.removeprefix(PHOTOS_FOLDER)


@dataclass(frozen=True)
class Capture:
    """The usable photographs of one folder. `Photo.image` is relative to `folder`."""

    folder: Path
    photos: tuple[Photo, ...]


@dataclass(frozen=True)
class View:
    """A registered photograph, undistorted.

    Args:
        name, duplicate_of, outside: as in `Photo`.
        image, mask, depth: as in `Photo`, relative to the reconstruction's folder.
        camera: pose and intrinsics.
        role: "train" or "test" where a file defines the split, or none is held out; "" elsewhere.
        light: exposure and white balance, see `scene.light`; None if they could not be measured.
        frame: the name of the panorama or wide fisheye that this is a face of; "" for a photograph.
    """

    name: str
    image: str
    camera: Camera
    duplicate_of: str = ""
    role: str = ""
    mask: str = ""
    outside: str = ""
    light: Light | None = None
    frame: str = ""
    depth: str = ""


@dataclass(frozen=True)
class RefinedCameras:
    """Cameras that training has refined.

    Args:
        poses: world_to_camera [4, 4] of views by name.
        focal_factor: of the focal lengths of all views.
    """

    poses: Mapping[str, NDArray[np.float64]]
    focal_factor: float

    def view(self, view: View) -> View:
        """`view` with its refined camera."""
        camera, factor = view.camera, self.focal_factor
        pose = self.poses.get(view.name, camera.world_to_camera)
        fx, fy = camera.fx * factor, camera.fy * factor
        return replace(view, camera=replace(camera, fx=fx, fy=fy, world_to_camera=pose))


@dataclass(frozen=True, repr=False)
class Reconstruction:
    """Posed pinhole views and a sparse point cloud, in the levelled and recentred world.

    Args:
        folder: `View.image` is relative to it.
        views: the registered photographs.
        points: [P, 3] float64.
        colours: [P, 3] uint8.
        errors_px: [P] mean reprojection error, pixels.
        tracks: [P] number of photographs that see the point.
        origin: [3] float64, added to positions to get back to the coordinates of `units`.
        units: "metres", or "arbitrary" if the scale of the scene is unknown.
        place: where the world is on the earth; None if that is unknown.
        levelled: whether the up direction (-Y) was found from the cameras.
        contradicted: whether the matches of some photographs contradict the cameras, so that these
            are believed only if training can reproduce photographs that took no part in it.
        file_from_world: [4, 4] similarity to the world of the file that the cameras came from; None
            where they were estimated.
    """

    folder: Path
    views: tuple[View, ...]
    points: NDArray[np.float64]
    colours: NDArray[np.uint8]
    errors_px: NDArray[np.float64]
    tracks: NDArray[np.int32]
    origin: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    units: str = "arbitrary"
    place: EarthPlace | None = None
    levelled: bool = False
    contradicted: bool = False
    file_from_world: NDArray[np.float64] | None = None

    def __repr__(self) -> str:
        return f"Reconstruction({len(self.views)} views, {len(self.points):,} points)"

    def with_cameras(self, refined: RefinedCameras | None) -> Reconstruction:
        """The same with refined cameras; itself for None."""
        if refined is None:
            return self
        return replace(self, views=tuple(refined.view(view) for view in self.views))

    def with_masks(self, masks: Mapping[str, Path]) -> Reconstruction:
        """The same, where views by name ignore what lies outside other masks."""
        views = (
            replace(view, mask=str(masks[view.name].absolute()), outside=IGNORE)
            if view.name in masks
            else view
            for view in self.views
        )
        return replace(self, views=tuple(views))


def split_held_out(views: tuple[View, ...]) -> tuple[tuple[View, ...], tuple[View, ...]]:
    """(training views, held-out test views). Held out, for evaluation only, is the first of every
    eight views by name; where views have roles, those with the role "test".

    The faces of a panorama or fisheye count as one, and are held out together. So do
    near-duplicates: one of them would measure how well the others were learnt. The first of the
    eight without any is preferred to them. With fewer than 4 views nothing is held out.
    """
    ordered = tuple(sorted(views, key=lambda view: view.name))
    if any(view.role for view in ordered):
        test = tuple(view for view in ordered if view.role == "test")
        return tuple(view for view in ordered if view.role != "test"), test
    of_view = [view.duplicate_of or view.frame or view.name for view in ordered]
    names = tuple(dict.fromkeys(of_view))
    if len(names) < 4:
        return ordered, ()
    several = {view.duplicate_of for view in ordered}
    eights = (names[i : i + HELD_OUT_EVERY] for i in range(0, len(names), HELD_OUT_EVERY))
    held = {min(eight, key=lambda name: name in several) for eight in eights}
    rows = list(zip(ordered, of_view, strict=True))
    return (
        tuple(view for view, name in rows if name not in held),
        tuple(view for view, name in rows if name in held),
    )


def why_none_is_held_out(views: Iterable[View]) -> str:
    """The reason where `split_held_out` holds none out, as a clause."""
    if any(view.role for view in views):
        return "all photographs are trained on"
    return "there are too few photographs to hold one out"


def evenly_spaced(items: Sequence[Item], most: int) -> list[Item]:
    """At most `most` of the items, evenly spaced: neighbouring photographs show much the same."""
    count = min(most, len(items))
    return [items[i * len(items) // count] for i in range(count)]


def scene_extent(views: tuple[View, ...]) -> float:
    """Extent of the scene as in the reference trainer, world units: 1.1 x the largest distance of a
    camera from the cameras' centre. Never 0.

    The centre is their geometric median and "largest" is the 95th percentile, so that one stray
    camera does not decide. The percentile is one camera's own distance, not a mean of two that
    could include the stray one.
    """
    centres = np.array([view.camera.centre for view in views])
    distances = np.linalg.norm(centres - geometric_median(centres), axis=1)
    return max(1.1 * float(np.percentile(distances, 95, method="lower")), 1e-6)


def geometric_median(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """[3] the point with the smallest sum of distances to `points` [N, 3], nearly, by Weiszfeld's
    iteration (1937). It turns with the world, which a median of each axis does not."""
    middle = points.mean(axis=0)
    for _ in range(50):
        away = np.linalg.norm(points - middle, axis=1)
        weights = 1.0 / np.maximum(away, 1e-9 * away.max() + 1e-150)
        middle = weights @ points / weights.sum()
    return np.asarray(middle)


def training_extent(reconstruction: Reconstruction) -> float:
    """The unit of length in training, world units.

    The larger of `scene_extent` and the depth at which the median camera sees its median point:
    the cameras of a phone held almost still say little about the size of the scene before them.
    Held-out views do not count.
    """
    seen = [float(np.median(depths)) for depths in depths_seen(reconstruction)]
    extent = scene_extent(split_held_out(reconstruction.views)[0])
    return max(extent, float(np.median(seen)) if seen else 0.0)


def depths_seen(reconstruction: Reconstruction) -> Iterator[NDArray[np.float64]]:
    """For each training view that sees points, their depths [K], world units. Points that others
    hide count, too."""
    for view in split_held_out(reconstruction.views)[0]:
        pixels, z = view.camera.project(reconstruction.points)
        depths = z[(z > 0) & view.camera.shows(pixels)]
        if len(depths):
            yield depths
