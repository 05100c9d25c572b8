"""The reference as a backend: draw, evaluate and train by the definition itself."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from stages.raster.definition import (
    CONTRIBUTIONS,
    ERROR_CHANGE,
    LARGEST_WEIGHT,
    PICTURE_CHANGE,
    SQUARED_WEIGHT,
    WEIGHT,
    WEIGHTED_RESIDUAL,
    Arrays,
    Backward,
    RasterSettings,
    gradient_columns,
    with_smoothing,
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
    """A `definition.Forward` that also keeps the inputs, to draw again with gradients."""

    image: NDArray[np.float32]
    visible: NDArray[np.int32]
    culled: int
    arrays: Arrays
    camera: Camera
    settings: RasterSettings


class ReferenceRasteriser:
    """Draws and differentiates in torch, in float64. Nothing is kept between passes: the backward
    pass draws again, block by block."""

    def loaded(self, arrays: Arrays) -> Arrays:
        """See `definition.Rasteriser`."""
        return arrays

    def forward(
        self, arrays: Arrays, camera: Camera, settings: RasterSettings, depths: bool = False
    ) -> ReferenceForward:
        """See `definition.Rasteriser`."""
        with torch.no_grad():
            p, widths = self._parameters(arrays)
            projected = project(p, camera, settings, widths)
            image, *planes = render_projected(p, projected, camera, settings)
            culled = int((~drawable(p, widths)).sum())
            every = [*image.unbind(-1), *(planes if depths else planes[:1])]
            picture = _host(torch.stack(every)).astype(np.float32)
            touching = projected.index[_touching(projected, camera)]
            visible = np.sort(_host(touching)).astype(np.int32)
        return ReferenceForward(picture, visible, culled, arrays, camera, settings)

    def backward(self, forward: ReferenceForward, v_image: NDArray[np.float32]) -> Backward:
        """See `definition.Rasteriser`."""
        rows, degree, arrays = forward.visible, forward.settings.sh_degree, forward.arrays
        p, widths = self._parameters(arrays)
        for tensor in p.tensors():
            tensor.requires_grad_()
        projected = project(p, forward.camera, forward.settings, widths)
        rgb = colours(p.rows(projected.index), self._tensor(forward.camera.centre), degree)
        shown, shades = _leaves(projected), rgb.detach().requires_grad_()
        self._blend_back(shown, shades, forward, self._tensor(v_image))
        _continue_backward((rgb, *vars(projected).values()), (shades, *vars(shown).values()))
        place = np.empty(len(arrays[0]), np.int64)
        place[_host(projected.index)] = np.arange(len(projected.index))
        coefficients = (min(degree, int(arrays[4].shape[1] ** 0.5) - 1) + 1) ** 2
        columns = [_gradient(t, rows) for t in p.tensors()[:4]]
        columns.append(_gradient(p.sh, rows)[:, : 3 * coefficients])
        values = np.concatenate(columns, 1)
        parameters = np.zeros((len(rows), gradient_columns(coefficients)), np.float32)
        parameters[:, : values.shape[1]] = np.clip(values, -_LARGEST, _LARGEST)
        means2d = _gradient(shown.means2d, place[rows]).astype(np.float32)
        return Backward(rows, parameters, means2d)

    def _blend_back(
        self, shown: Projected, shades: Tensor, forward: ReferenceForward, v_image: Tensor
    ) -> None:
        """Add up gradients of footprints and colours block by block, so that autograd's graph of a
        block is freed before the next."""
        background = self._tensor(forward.settings.background)
        for place, rows, pixels in reversed(list(picture_blocks(shown, forward.camera))):
            if not len(rows):
                continue
            weights, passed = weights_of(alphas_at(shown, rows, pixels))
            colour = weights.T @ shades[rows] + passed[:, None] * background
            torch.autograd.backward(colour, _part(v_image, place).T)

    def contributions(
        self, forward: ReferenceForward, residual: NDArray[np.float32]
    ) -> NDArray[np.float64]:
        """See `definition.Rasteriser`. Colour is affine in each alpha: without the splat a pixel
        changes by -w c + b alpha / (1 - alpha), with b what is composited behind it."""
        camera, settings = forward.camera, forward.settings
        (p, widths), planes = self._parameters(forward.arrays), self._tensor(residual)
        found = torch.zeros(len(forward.arrays[0]), CONTRIBUTIONS, dtype=torch.float64)
        with torch.no_grad():
            projected = project(p, camera, settings, widths)
            rgb = colours(p.rows(projected.index), self._tensor(camera.centre), settings.sh_degree)
            for place, rows, pixels in picture_blocks(projected, camera):
                if not len(rows):
                    continue
                alpha, errors = alphas_at(projected, rows, pixels), _part(planes, place)
                weights, passed = weights_of(alpha)
                change, square = torch.zeros_like(alpha), torch.zeros_like(alpha)
                for channel in range(3):
                    painted = weights * rgb[rows, channel : channel + 1]
                    background = passed * settings.background[channel]
                    behind = painted.flip(0).cumsum(0).flip(0) - painted + background
                    shift = behind * alpha / (1 - alpha) - painted
                    shift = torch.where(weights > 0, shift, torch.zeros_like(shift))
                    change += shift * (shift + 2 * errors[channel])
                    square += shift.square()
                index = projected.index[rows]
                found[index, ERROR_CHANGE] += change.sum(1)
                found[index, PICTURE_CHANGE] += square.sum(1)
                found[index, WEIGHT] += weights.sum(1)
                found[index, LARGEST_WEIGHT] = torch.maximum(
                    found[index, LARGEST_WEIGHT], weights.amax(1)
                )
                found[index, SQUARED_WEIGHT] += weights.square().sum(1)
                found[index, WEIGHTED_RESIDUAL:] += weights @ errors.T
        return _host(found).astype(np.float64)[forward.visible]

    def _parameters(self, arrays: Arrays) -> tuple[Parameters, Tensor | None]:
        """(the parameters, the widths of the smoothing filter or None)."""
        *parameters, widths = map(self._tensor, with_smoothing(arrays))
        return Parameters(*parameters), widths if len(widths) else None

    def _tensor(self, values: Any) -> Tensor:
        return torch.tensor(values, dtype=torch.float64)


def _touching(projected: Projected, camera: Camera) -> Tensor:
    """[M] whether a splat's box holds the centre of a pixel's row and column."""
    low, high = boxes(projected)
    size = torch.tensor([camera.width, camera.height], dtype=low.dtype, device=low.device)
    return ((high >= 0.5) & (low <= size - 0.5)).all(1)


def _part(planes: Tensor, place: tuple[int, int, int, int]) -> Tensor:
    """[3, P] of planes [3, H, W]: the pixels of a block, as `picture_blocks` gives its place."""
    top, bottom, left, right = place
    return planes[:, top:bottom, left:right].flatten(1)


def _leaves(projected: Projected) -> Projected:
    """The same values as leaf tensors of autograd."""
    kept = [t.detach().requires_grad_(t.requires_grad) for t in vars(projected).values()]
    return Projected(*kept)


def _continue_backward(made: Iterable[Tensor], leaves: Iterable[Tensor]) -> None:
    """Continue the backward pass from the leaves' gradients to the tensors that they copy."""
    given = [(t, leaf.grad) for t, leaf in zip(made, leaves, strict=True) if leaf.grad is not None]
    if given:
        torch.autograd.backward([t for t, _ in given], [grad for _, grad in given])


def _host(tensor: Tensor) -> NDArray[Any]:
    found: NDArray[Any] = tensor.detach().cpu().numpy()
    return found


def _gradient(tensor: Tensor, rows: NDArray[np.integer]) -> NDArray[np.float64]:
    width = int(np.prod(tensor.shape[1:]))
    if tensor.grad is None:
        return np.zeros((len(rows), width))
    return np.asarray(_host(tensor.grad)[rows].reshape(len(rows), width))
