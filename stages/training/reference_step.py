"""A training step's gradients by the torch reference: slow, and what the kernels are held to."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from stages.kernels.pool import Pool
from stages.raster.cpu.rasteriser import Backward, gradient_columns
from stages.raster.definition import RasterSettings
from stages.raster.reference import Parameters, project, render_projected
from stages.scene import Camera
from stages.training.loss import image_loss


def reference_gradients(
    pool: Pool,
    arrays: tuple[NDArray[np.float32], ...],
    camera: Camera,
    settings: RasterSettings,
    target: NDArray[np.uint8],
    v_image: NDArray[np.float32],
    smoothing: NDArray[np.float32],
) -> tuple[Backward, float]:
    """(gradients as the kernels would give them, loss); computed in float64."""
    p = Parameters(*(torch.tensor(a, dtype=torch.float64, requires_grad=True) for a in arrays))
    widths = torch.tensor(smoothing, dtype=torch.float64) if len(smoothing) else None
    projected = project(p, camera, settings, widths)
    projected.means2d.retain_grad()
    image, _, _, _ = render_projected(p, projected, camera, settings)
    planar = np.ascontiguousarray(image.detach().numpy().astype(np.float32).transpose(2, 0, 1))
    loss = image_loss(pool, planar, target, v_image)
    image.backward(torch.tensor(v_image.transpose(1, 2, 0), dtype=torch.float64))

    index = projected.index.numpy()
    bands = (min(settings.sh_degree, int(arrays[4].shape[1] ** 0.5) - 1) + 1) ** 2
    columns = [_gradient(t, index) for t in p.tensors()[:4]]
    columns.append(_gradient(p.sh, index)[:, : 3 * bands])
    values = np.concatenate(columns, 1)
    parameters = np.zeros((len(index), gradient_columns(bands)), np.float32)
    parameters[:, : values.shape[1]] = values
    means2d = _gradient(projected.means2d, np.arange(len(index))).astype(np.float32)
    return Backward(index.astype(np.int32), parameters, means2d), loss.value


def _gradient(tensor: torch.Tensor, index: NDArray[np.integer]) -> NDArray[np.float64]:
    if tensor.grad is None:
        return np.zeros((len(index), int(np.prod(tensor.shape[1:]))))
    return np.asarray(tensor.grad.numpy()[index].reshape(len(index), -1))
