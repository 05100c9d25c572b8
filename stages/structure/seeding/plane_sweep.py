"""Points that photographs agree on where structure from motion found none.

A plane sweep (Collins 1996, "A space-sweep approach to true multi-image matching"): a photograph's
partners, a few that see the same things from the side, are drawn small as it would see them if all
that they show lay on a plane before it, for many distances of that plane. Where neighbourhoods
correlate best is a guess at the depth. A guess counts only where the guesses of other photographs
say the same, and the measured points around it do not stand behind it: about one in 500 is then
wrong.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from stages.base import threads
from stages.photos.load import load_image, mask_of
from stages.scene import Camera, View
from stages.structure.seeding.projection import cells, pixel_centres, unproject, visible_points
from stages.structure.seeding.visibility import VisibilityConstraints

SIDE = 200  # pixels, longer side of the photographs compared
PLANES = 64
RADIUS = 3  # of the neighbourhood, pixels
PARTNERS = 4
BEST_ANGLE, ANGLE_SPREAD = 10.0, (4.0, 8.0)  # degrees between two photographs' rays; below, above
FEWEST_SHARED = 20  # points
SAMPLE = 1000  # points that tell which photographs go together
MARGIN = (0.7, 1.6)  # how far before the nearest and behind the farthest point is searched
FLAT = 2e-5  # variance of a neighbourhood: hundredths of the noise of a photograph's 8 bits
AGREE = 0.015  # of a depth
# (correlation, confirmations): fewer others will do where the likeness is closer
CONFIRMED = ((0.6, 3), (0.8, 2))
CELL = 2.0  # pixels: at most one point in each
SOLID = 250  # of 255: less of a pixel holds what a mask takes away
SAME_SURFACE = 0.05  # of a depth


@dataclass(frozen=True)
class _Guess:
    """depth, score [H, W]: of one photograph; score: correlation, -1 where there is no guess."""

    camera: Camera
    depth: NDArray[np.float32]
    score: NDArray[np.float32]


def plane_sweep_points(
    folder: Path, views: tuple[View, ...], points: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """(points [M, 3], colours [M, 3] in 0..1) to add to the measured `points` [P, 3].

    folder: where the views' image paths start.
    """
    ordered = sorted(views, key=lambda view: view.name)
    cameras = [view.camera.fitted(SIDE) for view in ordered]
    pictures = [
        load_image(folder / view.image, camera.width, camera.height)
        for view, camera in zip(ordered, cameras, strict=True)
    ]
    grey = [np.ascontiguousarray(picture.mean(2), np.float32) for picture in pictures]
    partners = _partners(cameras, points)
    with ThreadPoolExecutor(threads.count()) as pool:
        sweep = functools.partial(_swept, cameras=cameras, grey=grey, points=points)
        guesses = list(pool.map(sweep, range(len(cameras)), partners))
    for view, guess in zip(ordered, guesses, strict=True):
        mask = mask_of(folder, view, guess.camera.width, guess.camera.height)
        if mask is not None:
            guess.score[mask < SOLID] = -1
    places, colours = [points], [np.zeros((0, 3), np.float32)]
    for i, guess in enumerate(guesses):
        others = [j for j in range(len(guesses)) if j in partners[i] or i in partners[j]]
        sure = _confirmed(guess, [guesses[j] for j in others])
        rows, columns = _thinned(guess, sure, np.concatenate(places))
        at = pixel_centres(rows, columns)
        places.append(unproject(guess.camera, at, guess.depth[rows, columns].astype(np.float64)))
        colours.append(pictures[i][rows, columns])
    more = np.concatenate(places[1:] or [np.zeros((0, 3))])
    believed = VisibilityConstraints(views, points).confirm(more)
    return more[believed], np.concatenate(colours)[believed]


def _partners(cameras: list[Camera], points: NDArray[np.float64]) -> list[list[int]]:
    """For each photograph those that see much of the same, about ten degrees from the side."""
    chosen = np.unique(
        np.linspace(0, len(points) - 1, min(SAMPLE, len(points))).round().astype(int)
    )
    points = points[chosen]
    visible = np.zeros((len(cameras), len(points)), bool)
    rays = np.zeros((len(cameras), len(points), 3))
    for i, camera in enumerate(cameras):
        visible[i, visible_points(camera, points)[0]] = True
        towards = points - camera.centre
        rays[i] = towards / np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-12)
    found = []
    for i in range(len(cameras)):
        angle = np.degrees(np.arccos(np.clip((rays[i] * rays).sum(2), -1, 1)))
        spread = np.where(angle < BEST_ANGLE, *ANGLE_SPREAD)
        fitness = np.exp(-(((angle - BEST_ANGLE) / spread) ** 2) / 2)
        both = visible[i] & visible
        score = np.where(both.sum(1) >= FEWEST_SHARED, (fitness * both).sum(1), 0.0)
        score[i] = 0.0
        order = np.argsort(-score, kind="stable")[:PARTNERS]
        found.append([int(j) for j in order if score[j] > 0.02 * visible[i].sum()])
    return found


def _swept(
    i: int,
    partners: list[int],
    cameras: list[Camera],
    grey: list[NDArray[np.float32]],
    points: NDArray[np.float64],
) -> _Guess:
    """The best of PLANES planes at each pixel, as the two most alike of the partners see it."""
    camera = cameras[i]
    nothing = np.full((camera.height, camera.width), -1, np.float32)
    depths = visible_points(camera, points)[2]
    if not partners or not len(depths):
        return _Guess(camera, np.ones_like(nothing), nothing)
    nearest, farthest = np.percentile(depths, (1, 99)) * MARGIN
    inverse = np.linspace(1 / farthest, 1 / nearest, PLANES)
    mean = _box(grey[i])
    variance = np.maximum(_box(grey[i] * grey[i]) - mean * mean, 0)
    scores = np.empty((PLANES, camera.height, camera.width), np.float32)
    for plane, inverse_depth in enumerate(inverse):
        alike = []
        for j in partners:
            moved, missing = _moved(camera, cameras[j], grey[j], float(inverse_depth))
            mean2 = _box(moved)
            variance2 = np.maximum(_box(moved * moved) - mean2 * mean2, 0)
            covariance = _box(grey[i] * moved) - mean * mean2
            likeness = covariance / np.sqrt((variance + FLAT) * (variance2 + FLAT))
            likeness[missing] = -1
            alike.append(likeness)
        scores[plane] = _mean_of_best_two(alike)
    best = scores.argmax(0)
    score = scores.max(0)
    score[(best == 0) | (best == PLANES - 1) | (variance < FLAT / 2)] = -1
    depth = 1 / (inverse[0] + _peak(scores, best) * (inverse[1] - inverse[0]))
    return _Guess(camera, depth.astype(np.float32), score)


def _mean_of_best_two(alike: Sequence[NDArray[np.floating]]) -> NDArray[np.floating]:
    """Pixel by pixel; a fifth of what sorting takes."""
    best, *others = alike
    if not others:
        return best
    second = np.full_like(best, -np.inf)
    for other in others:
        second = np.maximum(second, np.minimum(best, other))
        best = np.maximum(best, other)
    return np.asarray((best + second) / 2)


def _box(picture: NDArray[np.float32]) -> NDArray[np.float32]:
    size = (2 * RADIUS + 1, 2 * RADIUS + 1)
    return np.asarray(cv2.blur(picture, size, borderType=cv2.BORDER_REFLECT), np.float32)


def _moved(
    camera: Camera, other: Camera, picture: NDArray[np.float32], inverse_depth: float
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """(`other`'s picture as `camera` sees it if it all lay on the plane; where there is none)."""
    rotation = other.world_to_camera[:3, :3] @ camera.world_to_camera[:3, :3].T
    shift = other.world_to_camera[:3, 3] - rotation @ camera.world_to_camera[:3, 3]
    plane = rotation + np.outer(shift, (0, 0, inverse_depth))
    warp = _intrinsics(other) @ plane @ np.linalg.inv(_intrinsics(camera))
    beyond = -10.0
    moved = cv2.warpPerspective(
        picture,
        warp,
        (camera.width, camera.height),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderValue=beyond,
    )
    return np.asarray(moved, np.float32), np.asarray(moved < -0.01)


def _intrinsics(camera: Camera) -> NDArray[np.float64]:
    """[3, 3] for OpenCV, which has the centre of the first pixel at 0."""
    return np.array([[camera.fx, 0, camera.cx - 0.5], [0, camera.fy, camera.cy - 0.5], [0, 0, 1]])


def _peak(scores: NDArray[np.float32], best: NDArray[np.intp]) -> NDArray[np.float64]:
    """[H, W] the best plane between planes: the top of a parabola through three scores."""
    middle = np.clip(best, 1, PLANES - 2)
    below, at, above = (
        np.take_along_axis(scores, (middle + k)[None], 0)[0].astype(np.float64) for k in (-1, 0, 1)
    )
    bend = np.minimum(below - 2 * at + above, -1e-6)
    return np.asarray(middle + np.clip(0.5 * (below - above) / bend, -1, 1), np.float64)


def _confirmed(guess: _Guess, others: list[_Guess]) -> NDArray[np.bool_]:
    """[H, W] where enough of the others' guesses agree with this one's."""
    height, width = guess.depth.shape
    rows, columns = np.divmod(np.arange(height * width), width)
    at = pixel_centres(rows, columns)
    places = unproject(guess.camera, at, guess.depth.ravel().astype(np.float64))
    sure = np.zeros(height * width, bool)
    for likeness, wanted in CONFIRMED:
        count = np.zeros(height * width, int)
        for other in others:
            landed, pixels, depths = visible_points(other.camera, places)
            there = cells(pixels)
            same = np.abs(other.depth[there] / depths - 1) < AGREE
            count[landed] += same & (other.score[there] > likeness)
        sure |= (count >= wanted) & (guess.score.ravel() > likeness)
    return sure.reshape(height, width)


def _thinned(
    guess: _Guess, sure: NDArray[np.bool_], points: NDArray[np.float64]
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """(rows, columns) of the best sure pixel of each cell in which no point lies already; a point
    far before or behind a sure surface lies on another."""
    height, width = sure.shape
    taken = np.zeros((int(height // CELL) + 1, int(width // CELL) + 1), bool)
    _, pixels, depths = visible_points(guess.camera, points)
    there = cells(pixels)
    same = np.abs(depths / guess.depth[there] - 1) < SAME_SURFACE
    rows, columns = cells(pixels[same | ~sure[there]], CELL)
    taken[rows, columns] = True
    rows, columns = np.nonzero(sure)
    down, across = cells(pixel_centres(rows, columns), CELL)
    cell = down * taken.shape[1] + across
    free = ~taken.ravel()[cell]
    rows, columns, cell = rows[free], columns[free], cell[free]
    order = np.lexsort((-guess.score[rows, columns], cell))
    _, first = np.unique(cell[order], return_index=True)
    return rows[order][first], columns[order][first]
