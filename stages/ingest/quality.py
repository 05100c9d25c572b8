"""Measures sharpness and brightness of photographs, and finds near-duplicates."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from stages.ingest.colour import luminance
from stages.scene import fitted_size

MEASURED_SIDE_PX = 800
THUMBNAIL_PX = (48, 36)
# Correlation of thumbnails above which two photographs count as taken from one spot; a shift by
# half a percent of the picture's width brings it to about 0.98.
_ALIKE = 0.98
_SECOND_DERIVATIVES = tuple(
    np.array(kernel, np.float32)
    for kernel in (
        [[0, 0, 0], [1, -2, 1], [0, 0, 0]],
        [[0, 1, 0], [0, -2, 0], [0, 1, 0]],
        [[1, 0, 0], [0, -2, 0], [0, 0, 1]],
        [[0, 0, 1], [0, -2, 0], [1, 0, 0]],
    )
)


@dataclass(frozen=True)
class Measures:
    """Measures of one photograph.

    Args:
        sharpness: see `sharpness`.
        log2_luminance: log2 of the median linear luminance.
        thumbnail: [36, 48] float32, zero mean, unit norm (0 for a uniform picture).
    """

    sharpness: float
    log2_luminance: float
    thumbnail: NDArray[np.float32]


def measure(pixels: NDArray[np.uint8], mask: NDArray[np.uint8] | None = None) -> Measures:
    """Measures of sRGB pixels [H, W, 3]. mask [H, W]: 0 where brightness does not count."""
    height, width = pixels.shape[:2]
    size = fitted_size(width, height, MEASURED_SIDE_PX)
    small = np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), np.uint8)
    grey = np.asarray(cv2.cvtColor(small, cv2.COLOR_RGB2GRAY), np.uint8)
    values = luminance(small)
    if mask is not None:
        inside = cv2.resize(mask, size, interpolation=cv2.INTER_NEAREST) > 0
        values = values[inside] if inside.any() else values
    median = float(np.median(values))
    return Measures(
        sharpness=float(f"{sharpness(grey):.5g}"),
        log2_luminance=round(float(np.log2(max(median, 2.0**-14))), 3),
        thumbnail=_thumbnail(grey),
    )


def sharpness(grey: NDArray[np.uint8]) -> float:
    """The ratio of fine to coarse detail, in the direction where it is least.

    It is the ratio of the energy of second derivatives at full scale to that after a blur of 2 px,
    in each of four directions, over the parts of the picture with most coarse detail. Unlike the
    variance of the Laplacian, it hardly depends on contrast or on how much of the picture is a bare
    wall. The direction with the least detail shows motion blur.
    """
    image = grey.astype(np.float32)
    blurred = cv2.GaussianBlur(image, (0, 0), 2.0)
    cells = (max(1, grey.shape[1] // 25), max(1, grey.shape[0] // 25))
    ratios = []
    for kernel in _SECOND_DERIVATIVES:
        fine, coarse = (
            cv2.resize(cv2.filter2D(level, -1, kernel) ** 2, cells, interpolation=cv2.INTER_AREA)
            for level in (image, blurred)
        )
        chosen = coarse >= np.percentile(coarse, 70)
        ratios.append(fine[chosen].sum() / (coarse[chosen].sum() + 1e-3))
    return float(np.sqrt(min(ratios)))


def _thumbnail(grey: NDArray[np.uint8]) -> NDArray[np.float32]:
    small = cv2.resize(grey, THUMBNAIL_PX, interpolation=cv2.INTER_AREA).astype(np.float32)
    small -= small.mean()
    norm = float(np.linalg.norm(small))
    return small / norm if norm > 1.0 else np.zeros_like(small)


def near_duplicates(thumbnails: list[NDArray[np.float32]]) -> list[tuple[int, ...]]:
    """Groups of indices of photographs that show nearly the same as the first of their group, in
    order. Frames of a slow walk are each like the one before, and end far from the first."""
    stack = np.stack([thumbnail.ravel() for thumbnail in thumbnails])
    groups: dict[int, list[int]] = {}
    for number, thumbnail in enumerate(stack):
        firsts = list(groups)
        alike = stack[firsts] @ thumbnail
        if len(firsts) and alike.max() > _ALIKE:
            groups[firsts[int(alike.argmax())]].append(number)
        else:
            groups[number] = [number]
    return [tuple(group) for group in groups.values() if len(group) > 1]
