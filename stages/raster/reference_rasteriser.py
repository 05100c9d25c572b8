"""The reference as a backend: what it takes to draw, judge and train by the definition itself."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from stages.raster.definition import (
    CHANGE,
    CONTRIBUTIONS,
    LARGEST,
    NO_SMOOTHING,
    PULL,
    SQUARES,
    WEIGHT,
    Arrays,
    Backward,
    RasterSettings,
    gradient_columns,
)
from stages.raster.reference import (
    Parameters,
    Projected,
    alphas_at,
    boxes,
    colours,
    drawable,
    picture_blocks,
    project,
    render_projected,
    weights_of,
)
from stages.scene import Camera

_LARGEST = float(np.finfo(np.float32).max)


@dataclass(frozen=True)
class ReferenceForward:
    """As `definition.Forward`; and what was drawn, for drawing it again with gradients."""

    image: NDArray[np.float32]
    visible: NDArray[np.int32]
    culled: int
    arrays: Arrays
    camera: Camera
    settings: RasterSettings
    smoothing: NDArray[np.float32]


class ReferenceRasteriser:
    """Draws and differentiates in float64 torch. Keeps nothing between two passes: the way back
    draws again, with gradients."""

    def forward(
        self,
        arrays: Arrays,
        camera: Camera,
        settings: RasterSettings,
        smoothing: NDArray[np.float32] = NO_SMOOTHING,
        depths: bool = False,
    ) -> ReferenceForward:
        """See `definition.Rasteriser`."""
        p = _parameters(arrays)
        with torch.no_grad():
            projected = project(p, camera, settings, _widths(smoothing))
            image, *planes = render_projected(p, projected, camera, settings)
            culled = int((~drawable(p, _widths(smoothing))).sum())
        every = [*image.unbind(-1), *(planes if depths else planes[:1])]
        picture = torch.stack(every).numpy().astype(np.float32)
        visible = np.sort(projected.index[_touching(projected, camera)].numpy()).astype(np.int32)
        return ReferenceForward(picture, visible, culled, arrays, camera, settings, smoothing)

    def backward(
        self,
        arrays: Arrays,
        forward: ReferenceForward,
        v_image: NDArray[np.float32],
        smoothing: NDArray[np.float32] = NO_SMOOTHING,
    ) -> Backward:
        """See `definition.Rasteriser`."""
        p = _parameters(arrays, requires_grad=True)
        projected = project(p, forward.camera, forward.settings, _widths(smoothing))
        projected.means2d.retain_grad()
        image, _, _, _ = render_projected(p, projected, forward.camera, forward.settings)
        if image.requires_grad:
            torch.autograd.backward(
                image, torch.tensor(v_image.transpose(1, 2, 0), dtype=torch.float64)
            )
        rows = forward.visible
        place = np.empty(len(arrays[0]), np.int64)
        place[projected.index.numpy()] = np.arange(len(projected.index))
        bands = (min(forward.settings.sh_degree, int(arrays[4].shape[1] ** 0.5) - 1) + 1) ** 2
        columns = [_gradient(t, rows) for t in p.tensors()[:4]]
        columns.append(_gradient(p.sh, rows)[:, : 3 * bands])
        values = np.concatenate(columns, 1)
        parameters = np.zeros((len(rows), gradient_columns(bands)), np.float32)
        parameters[:, : values.shape[1]] = np.clip(values, -_LARGEST, _LARGEST)
        means2d = _gradient(projected.means2d, place[rows]).astype(np.float32)
        return Backward(rows, parameters, means2d)

    def contributions(
        self, forward: ReferenceForward, residual: NDArray[np.float32]
    ) -> NDArray[np.float64]:
        """See `definition.Rasteriser`. Colour is affine in each alpha: without the splat a pixel
        changes by -w c + behind alpha / (1 - alpha), "behind" what is composited behind it."""
        camera, settings = forward.camera, forward.settings
        p = _parameters(forward.arrays)
        found = torch.zeros(len(forward.arrays[0]), CONTRIBUTIONS, dtype=torch.float64)
        with torch.no_grad():
            projected = project(p, camera, settings, _widths(forward.smoothing))
            centre = torch.tensor(camera.centre, dtype=torch.float64)
            rgb = colours(p.rows(projected.index), centre, settings.sh_degree)
            planes = torch.tensor(residual, dtype=torch.float64)
            for rows, alpha, errors in _blocks(projected, camera, planes):
                weights, passed = weights_of(alpha)
                change = torch.zeros_like(alpha)
                for channel in range(3):
                    painted = weights * rgb[rows, channel : channel + 1]
                    background = passed * settings.background[channel]
                    behind = painted.flip(0).cumsum(0).flip(0) - painted + background
                    shift = behind * alpha / (1 - alpha) - painted
                    shift = torch.where(weights > 0, shift, torch.zeros_like(shift))
                    change += shift * (shift + 2 * errors[channel])
                index = projected.index[rows]
                found[index, CHANGE] += change.sum(1)
                found[index, WEIGHT] += weights.sum(1)
                found[index, LARGEST] = torch.maximum(found[index, LARGEST], weights.amax(1))
                found[index, SQUARES] += weights.square().sum(1)
                found[index, PULL:] += weights @ errors.T
        return found.numpy()[forward.visible]


def _touching(projected: Projected, camera: Camera) -> Tensor:
    """[M] whether a splat's box holds the centre of a pixel's row and column."""
    low, high = boxes(projected)
    size = torch.tensor([camera.width, camera.height], dtype=low.dtype)
    return ((high >= 0.5) & (low <= size - 0.5)).all(1)


def _blocks(
    projected: Projected, camera: Camera, planes: Tensor
) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """(rows of the splats, their alphas [M, P], the planes [3, P]) of the picture's blocks that
    hold any splat."""
    for (top, bottom, left, right), rows, pixels in picture_blocks(projected, camera):
        if len(rows):
            part = planes[:, top:bottom, left:right].flatten(1)
            yield rows, alphas_at(projected, rows, pixels), part


def _parameters(arrays: Arrays, requires_grad: bool = False) -> Parameters:
    return Parameters(
        *(torch.tensor(a, dtype=torch.float64, requires_grad=requires_grad) for a in arrays)
    )


def _widths(smoothing: NDArray[np.float32]) -> Tensor | None:
    return torch.tensor(smoothing, dtype=torch.float64) if len(smoothing) else None


def _gradient(tensor: Tensor, rows: NDArray[np.integer]) -> NDArray[np.float64]:
    width = int(np.prod(tensor.shape[1:]))
    if tensor.grad is None:
        return np.zeros((len(rows), width))
    return np.asarray(tensor.grad.numpy()[rows].reshape(len(rows), width))
