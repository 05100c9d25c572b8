"""SIFT features of every photograph, in the worker process (imports pycolmap).

OpenCV's SIFT is several times as fast as COLMAP's. Features are written as COLMAP writes its own.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from stages.base import memory
from stages.base.memory import MIB
from stages.sfm.worker import database as sqlite
from stages.sfm.worker import new_database
from stages.sfm.worker.job import Features, Photographs, Project, Sift
from stages.sfm.worker.progress import ProgressWriter

LARGEST_SIDE = 3200  # pixels; features of larger photographs are found at this size
LAYERS = 3  # per octave
# Bytes per pixel: six blurred pictures and five differences, float32, of a picture of twice the
# size, of its half, its quarter and so on.
_PIXEL_BYTES = 11 * 4 * 4 * 4 / 3
_LENGTH = 512.0  # norm of a descriptor

KeypointsAndDescriptors = tuple[NDArray[np.float32], NDArray[np.uint8]]


def extract_features(job: Features) -> None:
    """Write the SIFT features of every photograph to the database, which may already hold some."""
    path, photographs = job.project.database, job.project.photographs
    if not path.exists():
        new_database.create(path, photographs)
    have = sqlite.photographs_with_features(path)
    missing = [position for position in range(len(photographs)) if position not in have]
    _extract(job.project, job.sift, missing, len(have))


def _extract(project: Project, sift: Sift, missing: Sequence[int], have: int) -> None:
    progress = ProgressWriter(project.database)
    cv2.setNumThreads(1)  # one thread per photograph is faster than several
    threads = _threads(project)
    with (
        pycolmap.Database.open(project.database) as database,
        ThreadPoolExecutor(threads) as pool,
    ):
        results = pool.map(partial(_features_of, project.photographs, sift), missing)
        for done, (position, (keypoints, rows)) in enumerate(zip(missing, results, strict=True), 1):
            database.write_keypoints(position + 1, keypoints)
            descriptors = pycolmap.FeatureDescriptors(pycolmap.FeatureExtractorType.SIFT, rows)
            database.write_descriptors(position + 1, descriptors)
            progress.write("extracting features", have + done, have + len(missing))


def _features_of(photographs: Photographs, sift: Sift, position: int) -> KeypointsAndDescriptors:
    mask = photographs.masks[position]
    return sift_features(
        photographs.folder / photographs.names[position],
        sift.max_features,
        sift.peak_threshold,
        photographs.folder / mask if mask else None,
    )


def _threads(project: Project) -> int:
    """One per core, as long as their pictures fit in half of the free memory."""
    cameras = project.photographs.cameras
    pixels = max(math.prod(_reduced(camera.width, camera.height)) for camera in cameras)
    available_mib = memory.available_mib()
    return max(1, int(min(project.threads, 0.5 * available_mib / (pixels * _PIXEL_BYTES / MIB))))


def sift_features(
    photograph: Path, most: int, peak_threshold: float, mask: Path | None = None
) -> KeypointsAndDescriptors:
    """(keypoints, descriptors) of a picture file, largest first, in COLMAP's conventions.

    keypoints [N, 4] float32: x, y (pixels, pixel centres at +0.5), scale (pixels), orientation
    (radians, from x to y). descriptors [N, 128] uint8 (RootSIFT: Arandjelovic 2012).

    Args:
        photograph: the picture.
        most: how many features to keep, the strongest.
        peak_threshold: of differences of blurred pictures, for white = 1.
        mask: a picture of the same size; features where it is below half are not extracted.

    Raises ValueError if a picture cannot be read.
    """
    picture = read_grey(photograph)
    height, width = picture.shape
    reduced = _reduced(width, height)
    if reduced != (width, height):
        picture = np.asarray(cv2.resize(picture, reduced, interpolation=cv2.INTER_AREA), np.uint8)
    inside = None
    if mask is not None:
        small = cv2.resize(read_grey(mask), reduced, interpolation=cv2.INTER_NEAREST)
        inside = np.where(small > 127, np.uint8(255), np.uint8(0))
    sift = cv2.SIFT.create(
        nfeatures=most,
        nOctaveLayers=LAYERS,
        contrastThreshold=peak_threshold * LAYERS,
        # Without it, keypoints are a quarter of a pixel off, as the doubled picture is.
        enable_precise_upscale=True,
    )
    found, descriptors = sift.detectAndCompute(picture, inside)
    if descriptors is None:
        return np.empty((0, 4), np.float32), np.empty((0, 128), np.uint8)
    rows = np.array([(*point.pt, point.size / 2, point.angle) for point in found], np.float32)
    rows[:, :2] = (rows[:, :2] + 0.5) * (width / reduced[0], height / reduced[1])
    rows[:, 2] *= math.sqrt(width * height / (reduced[0] * reduced[1]))
    rows[:, 3] = np.radians(rows[:, 3])
    order = np.lexsort((rows[:, 3], rows[:, 1], rows[:, 0], -rows[:, 2]))[:most]
    return rows[order], _root(descriptors[order])


def read_grey(path: Path) -> NDArray[np.uint8]:
    """[H, W] a picture file. Raises ValueError if it cannot be read."""
    flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
    picture = cv2.imdecode(np.fromfile(path, np.uint8), flags)
    if picture is None:
        raise ValueError(f"{path} cannot be read")
    return np.asarray(picture, np.uint8)


def _reduced(width: int, height: int) -> tuple[int, int]:
    scale = min(1.0, LARGEST_SIDE / max(width, height))
    return max(1, round(width * scale)), max(1, round(height * scale))


def _root(descriptors: np.ndarray) -> NDArray[np.uint8]:
    """RootSIFT: square roots of L1-normalised histograms (Hellinger kernel)."""
    sums = np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-12)
    roots: NDArray[np.float32] = np.rint(_LENGTH * np.sqrt(descriptors / sums))
    return np.minimum(roots, 255).astype(np.uint8)
