"""Chooses pinhole pictures (faces) that together show what a wide fisheye photograph shows.

One pinhole picture sees 60 degrees to either side of its axis. Where it would lose more than a
quarter of the field of view, two faces side by side are used, or the faces of a cube in front of
the camera. All have the photograph's position, its focal length and known turns.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from stages.cameras.lens import Lens
from stages.cameras.undistortion import WIDEST, undistorted_camera
from stages.ingest.faces import direction_name, face_rotation
from stages.scene import Camera

MOST_LOST = 0.25  # of the solid angle, by one pinhole picture
ALL = 0.999  # of the solid angle, which is sampled
_HALVES_DEG = (30, 35, 40, 45, 50)  # by which two faces are turned from the axis
_CUBE = ((0, 0), (90, 0), (270, 0), (0, 90), (0, -90), (180, 0))  # longitude, latitude
_MARGIN = 1  # pixels by which faces overlap
_FEWEST = 16  # pixels, of either side of a face
_SAMPLES = 20_000  # directions of the sphere


@dataclass(frozen=True)
class Field:
    """The field of view of a fisheye photograph.

    Args:
        camera, lens: of the photograph.
        radius_px: of the image circle around the principal point; infinite if it has none.
    """

    camera: Camera
    lens: Lens
    radius_px: float = np.inf

    @cached_property
    def angle(self) -> float:
        """The angle from the axis, radians, up to which the lens is injective."""
        return self.lens.widest_angle()

    def shows(self, rays: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """(pixels [..., 2] of the photograph, [...] whether it shows the rays [..., 3])."""
        camera = self.camera
        away = self.lens.project(rays) * (camera.fx, camera.fy)
        pixels = away + np.array([camera.cx, camera.cy])
        across = np.linalg.norm(rays[..., :2], axis=-1)
        shown = np.arctan2(across, rays[..., 2]) <= self.angle
        shown &= np.linalg.norm(away, axis=-1) <= self.radius_px
        shown &= ((pixels >= 0) & (pixels <= (camera.width, camera.height))).all(axis=-1)
        return pixels, shown

    def directions(self) -> NDArray[np.float64]:
        """[N, 3] directions that it shows, spread evenly."""
        rays = _sphere()
        return rays[self.shows(rays)[1]]

    def folded_share(self) -> float:
        """The share of the picture, within the image circle, that lies beyond `angle`."""
        turns = np.linspace(0, 2 * np.pi, 64)
        edge = np.stack([np.cos(turns), np.sin(turns)], -1) * np.sin(self.angle)
        rays = np.column_stack([edge, np.full(len(turns), np.cos(self.angle))])
        camera = self.camera
        focal = np.array([camera.fx, camera.fy])
        limit = np.linalg.norm(self.lens.project(rays) * focal, axis=-1).min()
        x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
        away = np.hypot(x - camera.cx, y - camera.cy)
        inside = away <= self.radius_px
        return float((away[inside] > limit).mean()) if inside.any() else 0.0


@dataclass(frozen=True)
class FisheyeFace:
    """A pinhole picture of a part of a field of view.

    Args:
        name: its direction, as of a panorama's face; "" for the only picture of a photograph.
        rotation: [3, 3] from the photograph's axes to those of the pinhole camera.
        camera: the pinhole camera; its pose is without meaning.
        whole: whether the photograph shows every pixel of it.
    """

    name: str
    rotation: NDArray[np.float64]
    camera: Camera
    whole: bool

    def rays(self) -> NDArray[np.float64]:
        """[H, W, 3] what each pixel shows, in the photograph's axes, at z = 1 of the face."""
        camera = self.camera
        u = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
        v = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
        x, y = np.meshgrid(u, v)
        return np.stack([x, y, np.ones_like(x)], axis=-1) @ self.rotation


def faces_of(field: Field) -> tuple[FisheyeFace, ...]:
    """The faces that show `field`; () where one pinhole picture is enough."""
    rays = field.directions()
    pinhole = undistorted_camera(field.camera, field.lens)
    if _shown(rays, np.eye(3), _limits_of(pinhole)).mean() >= 1.0 - MOST_LOST:
        return ()
    for layout in _layouts():
        covered = [_shown(rays, face_rotation(*at), limits) for at, limits in layout]
        if np.any(covered, axis=0).mean() >= ALL:
            break
    found = (_face(field, *one) for one in layout)
    return tuple(face for face in found if face is not None)


def only_face(field: Field) -> FisheyeFace:
    """The one pinhole picture of a photograph whose field of view ends at an image circle."""
    pinhole = undistorted_camera(field.camera, field.lens)
    face = FisheyeFace("", np.eye(3), pinhole, whole=False)
    return replace(face, whole=bool(field.shows(face.rays())[1].all()))


def shown_share(field: Field, faces: tuple[FisheyeFace, ...]) -> float:
    """The share of the solid angle of `field` that the faces show."""
    rays = field.directions()
    shown = [_shown(rays, face.rotation, _limits_of(face.camera)) for face in faces]
    return float(np.any(shown, axis=0).mean())


_Limits = tuple[float, float, float, float]  # left, top, right, bottom, as X / Z and Y / Z
_Layout = tuple[tuple[tuple[int, int], _Limits], ...]


def _layouts() -> Iterator[_Layout]:
    """Directions of faces, longitude and latitude, and what each shows; the last is a cube."""
    for half in _HALVES_DEG:
        inner = float(np.tan(np.radians(half)))
        sides = (-WIDEST, -WIDEST, inner, WIDEST), (-inner, -WIDEST, WIDEST, WIDEST)
        yield ((360 - half, 0), sides[0]), ((half, 0), sides[1])
        ends = (-WIDEST, -WIDEST, WIDEST, inner), (-WIDEST, -inner, WIDEST, WIDEST)
        yield ((0, half), ends[0]), ((0, -half), ends[1])
    yield tuple((at, (-1.0, -1.0, 1.0, 1.0)) for at in _CUBE)


def _face(field: Field, at: tuple[int, int], limits: _Limits) -> FisheyeFace | None:
    """The face in direction `at`, cropped to what the photograph shows of it; None without any."""
    focal = float(np.sqrt(field.camera.fx * field.camera.fy))
    left, top, right, bottom = (int(np.ceil(abs(side) * focal)) + _MARGIN for side in limits)
    camera = Camera(left + right, top + bottom, focal, focal, left, top, np.eye(4))
    face = FisheyeFace(direction_name(*at), face_rotation(*at), camera, whole=False)
    _, inside = field.shows(face.rays())
    rows, columns = np.flatnonzero(inside.any(axis=1)), np.flatnonzero(inside.any(axis=0))
    if min(len(rows), len(columns)) < _FEWEST:
        return None
    (top, bottom), (left, right) = ((int(i[0]), int(i[-1]) + 1) for i in (rows, columns))
    cropped = replace(
        camera,
        width=right - left,
        height=bottom - top,
        cx=camera.cx - left,
        cy=camera.cy - top,
    )
    return replace(face, camera=cropped, whole=bool(inside[top:bottom, left:right].all()))


def _limits_of(camera: Camera) -> _Limits:
    return (
        -camera.cx / camera.fx,
        -camera.cy / camera.fy,
        (camera.width - camera.cx) / camera.fx,
        (camera.height - camera.cy) / camera.fy,
    )


def _shown(
    rays: NDArray[np.float64], rotation: NDArray[np.float64], limits: _Limits
) -> NDArray[np.bool_]:
    """[N] whether a pinhole camera with this rotation and these limits shows rays [N, 3]."""
    x, y, z = rotation @ rays.T
    left, top, right, bottom = limits
    shown = (z > 0) & (x >= left * z) & (x <= right * z) & (y >= top * z) & (y <= bottom * z)
    return np.asarray(shown)


def _sphere() -> NDArray[np.float64]:
    """[N, 3] unit directions, spread evenly over the sphere (a Fibonacci lattice)."""
    index = np.arange(_SAMPLES) + 0.5
    z = 1.0 - 2.0 * index / _SAMPLES
    turn = index * np.pi * (3.0 - np.sqrt(5.0))
    across = np.sqrt(1.0 - z**2)
    return np.stack([across * np.cos(turn), across * np.sin(turn), z], axis=-1)
