"""Printed ArUco markers in the photographs, alone or on a ChArUco board: lengths of their sides."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from stages.scene import Camera

_DICTIONARIES = tuple(
    getattr(cv2.aruco, name)
    for name in (
        *("DICT_4X4_1000", "DICT_5X5_1000", "DICT_6X6_1000", "DICT_7X7_1000"),
        *("DICT_ARUCO_ORIGINAL", "DICT_APRILTAG_36h11"),
    )
)
_SAMPLED = 12  # pictures in which each dictionary is tried
_NARROWEST_DEG = 2.0  # triangulation angle; below, depth is too inaccurate
_LARGEST_ERROR = 0.004  # reprojection error of a corner, in longer sides of the picture

Seen = list[tuple[int, NDArray[np.float64]]]  # (camera, corners [4, 2] in pixels)


def marker_sides(pictures: Sequence[Path], cameras: Sequence[Camera]) -> NDArray[np.float64]:
    """[S] lengths in world units of the sides of all markers in two or more pictures, which may be
    none. cameras: the pinhole cameras of `pictures`."""
    spread = np.linspace(0, len(pictures) - 1, min(_SAMPLED, len(pictures))).round().astype(int)
    detectors = [_detector(number) for number in _DICTIONARIES]
    counts = [sum(len(_detected(detector, pictures[i])) for i in spread) for detector in detectors]
    best = detectors[int(np.argmax(counts))]
    seen: dict[int, Seen] = defaultdict(list)
    if max(counts):
        for number, picture in enumerate(pictures):
            for marker, corners in _detected(best, picture).items():
                seen[marker].append((number, corners))
    triangulated = [_triangulated(places, cameras) for places in seen.values()]
    sides = [
        np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1)
        for corners in triangulated
        if corners is not None
    ]
    return np.concatenate(sides) if sides else np.zeros(0)


def _detector(dictionary: int) -> Any:
    options = cv2.aruco.DetectorParameters()
    options.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    return cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(dictionary), options)


def _detected(detector: Any, picture: Path) -> dict[int, NDArray[np.float64]]:
    """Corners [4, 2] in pixels by marker id; ids that occur twice are left out."""
    data = np.fromfile(picture, np.uint8)
    grey = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE) if data.size else None
    if grey is None:
        return {}
    corners, numbers, _ = detector.detectMarkers(grey)
    flat = [] if numbers is None else np.ravel(numbers).tolist()
    return {
        number: np.asarray(found, np.float64).reshape(4, 2)
        + 0.5  # OpenCV has pixel centres at whole numbers
        for number, found in zip(flat, corners, strict=True)
        if flat.count(number) == 1
    }


def _triangulated(places: Seen, cameras: Sequence[Camera]) -> NDArray[np.float64] | None:
    """[4, 3] a marker's corners in the world, triangulated; None if that is too inaccurate."""
    if len(places) < 2:
        return None
    chosen = [cameras[i] for i, _ in places]
    seen = np.array([corners for _, corners in places])  # [V, 4, 2]
    centres = np.array([camera.centre for camera in chosen])
    rays = np.array([_rays(camera, at) for camera, at in zip(chosen, seen, strict=True)])
    cosines = np.einsum("aci,bci->abc", rays, rays).min(axis=2)
    if np.degrees(np.arccos(np.clip(cosines.min(), -1.0, 1.0))) < _NARROWEST_DEG:
        return None
    perpendicular = np.eye(3) - rays[..., :, None] * rays[..., None, :]  # [V, 4, 3, 3]
    total = perpendicular.sum(axis=0)
    wanted = np.einsum("vcij,vj->ci", perpendicular, centres)
    corners = np.linalg.solve(total, wanted[..., None])[..., 0]
    for camera, at in zip(chosen, seen, strict=True):
        pixels, depths = camera.project(corners)
        worst = _LARGEST_ERROR * max(camera.width, camera.height)
        if (depths <= 0).any() or np.abs(pixels - at).max() > worst:
            return None
    return corners


def _rays(camera: Camera, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
    """[N, 3] unit directions in the world."""
    flat = (pixels - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
    local = np.hstack([flat, np.ones((len(flat), 1))])
    world = local @ camera.world_to_camera[:3, :3]
    return np.asarray(world / np.linalg.norm(world, axis=1, keepdims=True))
