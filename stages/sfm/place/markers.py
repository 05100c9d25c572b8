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
_FARTHEST_MOVE_PX = 2.0  # of a corner from where OpenCV has it
# Profiles of brightness across each side: their number, where on the side, samples of each, and how
# far it goes to both sides of the edge, in pixels and at most in lengths of the side.
_PROFILES, _PART_OF_SIDE, _SAMPLES = 64, (0.1, 0.9), 25
_PROFILE_PX, _PROFILE_SHARE = 4.0, 0.075
_NOISE = 0.15  # of the steepest slope of a profile; less does not count
_WEAKEST_EDGE = 0.5  # of the median contrast; less: something covers the edge

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
    if numbers is None:
        return {}
    flat, brightness = np.ravel(numbers).tolist(), np.asarray(grey, np.float32)
    return {
        number: _refined(brightness, np.asarray(found, np.float64).reshape(4, 2))
        + 0.5  # OpenCV has pixel centres at whole numbers
        for number, found in zip(flat, corners, strict=True)
        if flat.count(number) == 1
    }


def _refined(grey: NDArray[np.float32], corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """[4, 2] the intersections of lines that are fitted to the sides of a marker. OpenCV moves
    corners [4, 2] inwards, more so in small or blurred markers, because it sees one quadrant of
    black and three of white. A corner stays where a line fails or would move it too far."""
    points, ends = corners, np.roll(corners, -1, axis=0)
    for _ in range(2):  # the second time edges lie in the middle of the profiles
        points, ends = _edge_lines(grey, points, ends)
    along = ends - points
    before, lines_before = np.roll(points, 1, axis=0), np.roll(along, 1, axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        factor = _cross(points - before, along) / _cross(lines_before, along)
    crossed = before + factor[:, None] * lines_before
    moved = np.linalg.norm(crossed - corners, axis=1)
    return np.where((moved <= _FARTHEST_MOVE_PX)[:, None], crossed, corners)


def _edge_lines(
    grey: NDArray[np.float32], points: NDArray[np.float64], ends: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Two points [4, 2] each on the four edges from black to white near the lines from `points` to
    `ends`; NaN where too little of an edge is visible."""
    along = ends - points
    length = np.linalg.norm(along, axis=1)[:, None, None]
    normals = np.stack([along[:, 1], -along[:, 0]], axis=1) / length[:, 0]  # outwards
    share = np.linspace(*_PART_OF_SIDE, _PROFILES)
    offsets = np.linspace(-1, 1, _SAMPLES) * np.minimum(_PROFILE_PX, length * _PROFILE_SHARE)
    on_side = points[:, None] + share[:, None] * along[:, None]
    at = on_side[:, :, None] + offsets[..., None] * normals[:, None, None]
    inside = np.all((at >= 0) & (at <= np.array(grey.shape[::-1]) - 1), axis=(2, 3))
    known = np.nan_to_num(at, nan=-1.0).astype(np.float32).reshape(-1, _SAMPLES, 2)
    x, y = np.ascontiguousarray(np.moveaxis(known, -1, 0))
    profiles = cv2.remap(grey, x, y, cv2.INTER_LINEAR).reshape(at.shape[:3])
    slopes = np.maximum(np.diff(profiles, axis=2), 0.0)  # from black outwards to white
    slopes *= slopes > _NOISE * slopes.max(axis=2, keepdims=True)
    weights = slopes.sum(axis=2)
    middles = (offsets[..., 1:] + offsets[..., :-1]) / 2
    edges = (slopes * middles).sum(axis=2) / np.maximum(weights, 1e-9)
    seen = inside & (weights > _WEAKEST_EDGE * np.median(weights, axis=1, keepdims=True))
    shifts = np.array([_line(share[s], e[s]) for s, e in zip(seen, edges, strict=True)])
    return points + shifts[:, :1] * normals, ends + shifts[:, 1:] * normals


def _line(at: NDArray[np.float64], values: NDArray[np.float64]) -> tuple[float, float]:
    """Values at 0 and at 1 of a line through most of the points; NaN for too few points."""
    for _ in range(3):
        if len(at) < _PROFILES / 2:
            return np.nan, np.nan
        slope, start = np.polyfit(at, values, 1)
        off = np.abs(values - start - slope * at)
        near = off <= max(3 * float(np.median(off)), 0.05)
        at, values = at[near], values[near]
    return float(start), float(start + slope)


def _cross(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


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
