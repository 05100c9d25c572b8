"""The pinhole pictures of photographs with known cameras: one for each photograph, or several faces
for a wide fisheye. Masks of faces leave out what the photograph does not show."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from stages.base.errors import Interrupted
from stages.base.stage import Report
from stages.base.text import listed
from stages.cameras.lens import MAX_ANGLE
from stages.ingest.faces import face_photo
from stages.ingest.fisheye_faces import Field, FisheyeFace, faces_of, only_face, shown_share
from stages.ingest.image_circle import LOOKED_AT, brightest, circle_radius
from stages.ingest.masks import FOLDER
from stages.ingest.write import write_depth
from stages.scene import IGNORE, TRANSPARENT, Camera, Face, Photo, evenly_spaced
from stages.scene.pictures import load_depth
from stages.scene.rotations import quaternions_of
from stages.sfm.undistorted_images import (
    IMAGES,
    PosedPhoto,
    depth_file,
    mask_file,
    read_picture,
    write_picture_as,
    write_undistorted_images,
)

_LOST_SHARE = 0.02

_Tables = tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]  # x, y, inside


@dataclass(frozen=True)
class PinholeView:
    """A pinhole picture of a photograph, or of a part of it.

    Args:
        photo: describes the picture: the photograph, or one face of it.
        camera: pinhole, with its pose.
        number: of the photograph.
        rotation: [3, 3] from the photograph's axes to the camera's.
    """

    photo: Photo
    camera: Camera
    number: int
    rotation: NDArray[np.float64]


@dataclass(frozen=True)
class _Cut:
    """How a photograph is cut: its field of view and the faces that show it."""

    field: Field
    faces: tuple[FisheyeFace, ...]


def write_pinhole_views(
    posed: Sequence[PosedPhoto], source: Path, folder: Path, report: Report
) -> list[PinholeView]:
    """Write pinhole pictures, masks and depth maps; those of a photograph follow each other.

    Arguments as of `write_undistorted_images`. `report` also receives how much is lost. Raises
    Interrupted, and SplatError "sfm-photo-unreadable".
    """
    cuts = _cuts(posed, source, report)
    uncut = [i for i, cut in enumerate(cuts) if cut is None]
    views: list[PinholeView] = []
    shown = 0.0
    if uncut:
        whole = [posed[i] for i in uncut]
        pinholes, share = write_undistorted_images(whole, source, folder, report)
        shown += share * len(uncut)
        views += [
            PinholeView(posed[i].photo, camera, i, np.eye(3))
            for i, camera in zip(uncut, pinholes, strict=True)
        ]
    tables: dict[int, list[_Tables]] = {}  # of the last field: they are large
    for number, cut in enumerate(cuts):
        if cut is None:
            continue
        if report.stop_requested.is_set():
            raise Interrupted
        report.progress(number, len(posed), "undistorting", photographs=number)
        if id(cut) not in tables:
            tables = {id(cut): [_tables(cut.field, face) for face in cut.faces]}
        views += _write_faces(posed[number], number, cut, tables[id(cut)], source, folder)
        shown += shown_share(cut.field, cut.faces)
    report.progress(len(posed), len(posed), "undistorting", photographs=len(posed))
    _report(cuts, 1.0 - shown / len(posed), report)
    return sorted(views, key=lambda view: view.number)


def _cuts(posed: Sequence[PosedPhoto], source: Path, report: Report) -> list[_Cut | None]:
    """[V] how each photograph is cut; None: into one pinhole picture that needs no mask for its
    lens. Photographs of one camera share one `_Cut`."""
    photos = [taken.photo for taken in posed]
    groups: dict[tuple[object, ...], list[int]] = defaultdict(list)
    for i, taken in enumerate(posed):
        if taken.lens.by_angle:
            groups[taken.optics].append(i)
    cuts: list[_Cut | None] = [None] * len(posed)
    folded: list[str] = []
    for members in groups.values():
        camera, lens = posed[members[0]].camera, posed[members[0]].lens
        opaque = [i for i in members if photos[i].outside != TRANSPARENT]
        chosen = evenly_spaced(opaque, LOOKED_AT)
        pictures = (read_picture(source / photos[i].image) for i in chosen)
        radius = circle_radius(brightest(pictures), camera) if chosen else float("inf")
        field = Field(camera, lens, radius)
        if field.folded_share() > _LOST_SHARE:
            folded += [photos[i].name for i in members]
        faces = faces_of(field)
        if not faces and np.isfinite(radius):
            faces = tuple(face for face in (only_face(field),) if not face.whole)
        for i in members:
            cuts[i] = _Cut(field, faces) if faces else None
    if folded:
        report.warn(
            "cameras-lens-folds",
            "The lens that the camera file states shows two directions at one place of the "
            f"picture, far from its middle: what lies there is not used, of {listed(folded)}.",
        )
    return cuts


def _tables(field: Field, face: FisheyeFace) -> _Tables:
    """For cv2.remap (whose pixel centres are whole numbers); x and y are -1 where the photograph
    shows nothing."""
    pixels, inside = field.shows(face.rays())
    at = np.where(inside[..., None], pixels - 0.5, -1.0).astype(np.float32)
    return np.ascontiguousarray(at[..., 0]), np.ascontiguousarray(at[..., 1]), inside


def _write_faces(
    taken: PosedPhoto,
    number: int,
    cut: _Cut,
    tables: Sequence[_Tables],
    source: Path,
    folder: Path,
) -> Iterator[PinholeView]:
    """Writes the faces of a photograph, without those that its mask covers."""
    photo = taken.photo
    image = read_picture(source / photo.image)
    mask = read_picture(source / photo.mask)[..., 0] if photo.mask else None
    for face, (x, y, inside) in zip(cut.faces, tables, strict=True):
        part = _described(photo, face)
        if part.mask:
            kept = _kept(mask, part.outside, x, y, inside)
            if not kept.any():
                continue
            write_picture_as(folder / mask_file(part), kept)
        shown = cv2.remap(image, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        write_picture_as(folder / IMAGES / part.picture, np.where(inside[..., None], shown, 0))
        if part.depth:
            depth = _depth(load_depth(source / photo.depth), cut.field, face)
            write_depth(folder / depth_file(part), depth)
        pose = taken.camera.world_to_camera.copy()
        pose[:3] = face.rotation @ pose[:3]
        yield PinholeView(part, replace(face.camera, world_to_camera=pose), number, face.rotation)


def _described(photo: Photo, face: FisheyeFace) -> Photo:
    """The photograph that shows a face. Outside the field of view nothing is known."""
    part = photo
    if face.name:
        c = face.camera
        w, x, y, z = quaternions_of(face.rotation).tolist()
        cut_out = Face(photo.camera, photo.name, (w, x, y, z))
        part = face_photo(photo, face.name, c.width, c.height, c.fx)
        part = replace(part, face=cut_out, depth=photo.depth)
    if face.whole and not photo.mask:
        return part
    outside = photo.outside if face.whole else IGNORE
    return replace(part, mask=f"{FOLDER}/{part.picture}.png", outside=outside)


def _kept(
    mask: NDArray[np.uint8] | None,
    outside: str,
    x: NDArray[np.float32],
    y: NDArray[np.float32],
    inside: NDArray[np.bool_],
) -> NDArray[np.uint8]:
    """[h, w] the mask of a face: 0 where the photograph shows nothing or its mask is black."""
    if mask is None:
        return np.where(inside, np.uint8(255), np.uint8(0))
    soft = cv2.INTER_LINEAR if outside == TRANSPARENT else cv2.INTER_NEAREST
    kept = cv2.remap(mask, x, y, soft, borderMode=cv2.BORDER_REPLICATE)
    return np.where(inside, kept, 0).astype(np.uint8)


def _depth(depth: NDArray[np.float32], field: Field, face: FisheyeFace) -> NDArray[np.float32]:
    """[h, w] z of the face, from z of the photograph, at the depth map's own number of pixels a
    degree. z of the photograph says nothing of what lies beside the camera."""
    height, width = depth.shape
    across, down = width / field.camera.width, height / field.camera.height
    sides = (
        round(s * share) for s, share in ((face.camera.width, across), (face.camera.height, down))
    )
    small = replace(face, camera=face.camera.resized(*(max(1, side) for side in sides)))
    seen = field.camera.resized(width, height)
    rays = small.rays()
    x, y, inside = _tables(replace(field, camera=seen, radius_px=field.radius_px * across), small)
    z = rays[..., 2]
    inside &= z > np.cos(MAX_ANGLE) * np.linalg.norm(rays, axis=-1)
    found = cv2.remap(depth, x, y, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT)
    return np.where(inside, found / np.where(inside, z, 1.0), 0.0).astype(np.float32)


def _report(cuts: Sequence[_Cut | None], lost: float, report: Report) -> None:
    several = sum(cut is not None and len(cut.faces) > 1 for cut in cuts)
    if several:
        report.metric("wide_fisheyes", several)
    report.metric("area_lost_by_undistortion", round(lost, 4))
    if lost > _LOST_SHARE:
        report.warn(
            "sfm-edges-lost",
            f"The lens distortion is so strong that {lost:.0%} of the photographs' area, at their "
            "edges, is outside the undistorted pictures and is not used.",
        )
