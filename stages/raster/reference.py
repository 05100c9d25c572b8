"""The definition of a rendering, in torch: any dtype, any device, autograd.

Every backend is compared with this file in tests. It is written for clarity, not for speed.

A splat with mean m, rotation R(q), scales s and opacity o is seen through the local affine
approximation of the projection (Zwicker et al. 2001): with V = J W R diag(s), its footprint is a
Gaussian of covariance V V^T + e I, e the dilation. Along a pixel's ray splats are blended from
near to far: alpha = min(0.99, o exp(-d)), with d the exponent at the pixel. A splat is left out of
a pixel where alpha is below 1/255. A pixel is finished after the splat that takes its transmittance
below 8.6e-5.

Order: by depth (z in the camera) rounded to float32; equal depths by the splat's own values (mean,
opacity, scales, rotation, SH), so that the picture does not depend on the order of rows in a file.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from stages.base import torch_vml
from stages.raster.camera_row import clamp_limits
from stages.raster.definition import (
    ALPHA_MAX,
    ALPHA_MIN,
    COLOUR_MAX,
    LOG_SCALE_MAX,
    QUATERNION_MIN,
    SCALE_MAX,
    TRANSMITTANCE_MIN,
    RasterSettings,
)
from stages.raster.sh import C0, basis_columns
from stages.scene import Camera, Splats

torch_vml.warm_up()

BLOCK = 32  # pixels; the picture is computed block by block to bound memory
MOST = 4_000_000  # (splat, pixel) pairs at once: 32 MB a tensor in float64, about 30 of them


@dataclass(frozen=True)
class Parameters:
    """The five arrays of `Splats` as tensors of one dtype; see there for shapes."""

    means: Tensor
    quaternions: Tensor
    log_scales: Tensor
    opacity_logits: Tensor
    sh: Tensor

    def rows(self, index: Tensor) -> Parameters:
        return Parameters(*(tensor[index] for tensor in self.tensors()))

    def tensors(self) -> tuple[Tensor, ...]:
        return (self.means, self.quaternions, self.log_scales, self.opacity_logits, self.sh)


def parameters_of(splats: Splats, dtype: torch.dtype = torch.float64) -> Parameters:
    """Leaf tensors of `splats`, ready for autograd."""
    return Parameters(*(torch.tensor(a, dtype=dtype, requires_grad=True) for a in splats.arrays))


def drawable(p: Parameters, smoothing: Tensor | None = None) -> Tensor:
    """[N] bool: values are finite, float32 can hold the squares of scales and smoothing widths, and
    the quaternion is not zero."""
    finite = torch.stack([t.flatten(1).isfinite().all(1) for t in map(_two_d, p.tensors())]).all(0)
    bounded = (p.log_scales <= LOG_SCALE_MAX).all(1)
    rotates = p.quaternions.abs().amax(1) >= QUATERNION_MIN
    if smoothing is not None:
        bounded &= (smoothing >= 0) & (smoothing <= SCALE_MAX)
    return finite & bounded & rotates


def _two_d(tensor: Tensor) -> Tensor:
    return tensor[:, None] if tensor.ndim == 1 else tensor


def rotation_matrices(quaternions: Tensor) -> Tensor:
    """[N, 3, 3] of quaternions w, x, y, z of any norm; scaled first: no square overflows."""
    q = quaternions / quaternions.abs().amax(1, keepdim=True).detach()
    w, x, y, z = (q / q.norm(dim=1, keepdim=True)).unbind(1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def sh_basis(directions: Tensor, degree: int) -> Tensor:
    """[N, (degree + 1)^2] real spherical harmonics of unit directions [N, 3]."""
    x, y, z = directions.unbind(-1)
    return torch.stack([torch.full_like(x, C0), *basis_columns(x, y, z, degree)], -1)


def colours(p: Parameters, camera_centre: Tensor, degree: int) -> Tensor:
    """[N, 3] colour of each splat seen from `camera_centre`, 0 to COLOUR_MAX."""
    offset = p.means - camera_centre
    directions = offset / offset.norm(dim=1, keepdim=True)
    degree = min(degree, int(p.sh.shape[1] ** 0.5) - 1)
    basis = sh_basis(directions, degree)
    return (0.5 + (basis[:, :, None] * p.sh[:, : basis.shape[1]]).sum(1)).clamp(0.0, COLOUR_MAX)


@dataclass(frozen=True)
class Projected:
    """Footprints of M splats; those of `project` are in blending order.

    index [M] rows of the input. means2d [M, 2] px. a, b, c [M]: cov2d = [[a, b], [b, c]], px^2,
    with its determinant det [M]. opacities [M], compensation included. depths [M].
    """

    index: Tensor
    means2d: Tensor
    a: Tensor
    b: Tensor
    c: Tensor
    det: Tensor
    opacities: Tensor
    depths: Tensor

    def rows(self, rows: Tensor) -> Projected:
        """The footprints of these rows."""
        return Projected(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))


def apply_smoothing(p: Parameters, widths: Tensor) -> tuple[Tensor, Tensor]:
    """([N, 3] scales, [N] factor of the opacity) under 3D smoothing filters of `widths` [N].

    A product of ratios per axis: a ratio of determinants underflows.
    """
    scales, f = p.log_scales.exp(), widths[:, None]
    larger, smaller = torch.maximum(scales, f), torch.minimum(scales, f)
    widened = larger * (1 + (smaller / larger).square()).sqrt()
    return widened, (scales / widened).prod(1)


def project(
    p: Parameters, camera: Camera, settings: RasterSettings, smoothing: Tensor | None = None
) -> Projected:
    """Footprints of the splats in front of the near plane, nearest first."""
    found = footprints(p, camera, settings, smoothing)
    return found.rows(_order(p.rows(found.index), found.depths))


def footprints(
    p: Parameters, camera: Camera, settings: RasterSettings, smoothing: Tensor | None = None
) -> Projected:
    """As `project`, in the order of the splats."""
    like: dict[str, Any] = {"dtype": p.means.dtype, "device": p.means.device}
    world_to_camera = torch.tensor(camera.world_to_camera, **like)
    rotation, translation = world_to_camera[:3, :3], world_to_camera[:3, 3]
    z = (p.means.detach() @ rotation.T + translation)[:, 2]
    index = (drawable(p, smoothing) & (z > settings.near)).nonzero()[:, 0]
    p = p.rows(index)
    scales, kept = p.log_scales.exp(), torch.ones_like(z[index])
    if smoothing is not None:
        scales, kept = apply_smoothing(p, smoothing[index])
    at = p.means @ rotation.T + translation
    z = at[:, 2]
    slope_x, slope_y = at[:, 0] / z, at[:, 1] / z
    means2d = torch.stack([camera.fx * slope_x + camera.cx, camera.fy * slope_y + camera.cy], 1)

    low_x, high_x, low_y, high_y = clamp_limits(camera)
    jacobian = torch.zeros(len(index), 2, 3, **like)
    jacobian[:, 0, 0] = camera.fx / z
    jacobian[:, 0, 2] = -camera.fx * slope_x.clamp(low_x, high_x) / z
    jacobian[:, 1, 1] = camera.fy / z
    jacobian[:, 1, 2] = -camera.fy * slope_y.clamp(low_y, high_y) / z
    v = jacobian @ rotation @ rotation_matrices(p.quaternions) * scales[:, None, :]
    # By Cauchy-Binet det(V V^T) is the sum of the squared 2x2 minors: never negative.
    minors = torch.linalg.cross(v[:, 0], v[:, 1]).square().sum(1)
    a0, b, c0 = v[:, 0].square().sum(1), (v[:, 0] * v[:, 1]).sum(1), v[:, 1].square().sum(1)
    e = settings.dilation_px2
    det = minors + e * (a0 + c0) + e * e
    opacities = p.opacity_logits.sigmoid() * kept
    if settings.antialias:
        least = max(1e-60, torch.finfo(minors.dtype).tiny)
        opacities = opacities * (minors.clamp_min(least) / det).sqrt()
    seen = (opacities >= ALPHA_MIN).nonzero()[:, 0]
    return Projected(index, means2d, a0 + e, b, c0 + e, det, opacities, z).rows(seen)


def _order(p: Parameters, z: Tensor) -> Tensor:
    keys = [z.detach().to(torch.float32)[:, None]]
    keys += [
        _two_d(t.detach()) for t in (p.means, p.opacity_logits, p.log_scales, p.quaternions)
    ] + [p.sh.detach().flatten(1)]
    table = torch.cat([k.cpu().to(torch.float64) for k in keys], 1).numpy()
    return torch.from_numpy(np.lexsort(table.T[::-1])).to(z.device)


def alphas_at(projected: Projected, rows: Tensor, pixels: Tensor) -> Tensor:
    """[M, P] alpha of splats `rows`, nearest first, at pixel centres [P, 2]; 0 where a splat is
    left out, being too faint or behind the one that finished the pixel.

    The exponent in Cholesky form: never negative, whatever the rounding.
    """
    q = projected.rows(rows)
    dx = pixels[None, :, 0] - q.means2d[:, None, 0]
    dy = pixels[None, :, 1] - q.means2d[:, None, 1]
    wide = (q.a >= q.c)[:, None]
    major = torch.where(wide, q.a[:, None], q.c[:, None])
    u, v = torch.where(wide, dx, dy), torch.where(wide, dy, dx)
    across = v - q.b[:, None] / major * u
    exponent = 0.5 * (u * u / major + across * across * (major / q.det[:, None]))
    alpha = (q.opacities[:, None] * torch.exp(-exponent)).clamp_max(ALPHA_MAX)
    alpha = torch.where(alpha >= ALPHA_MIN, alpha, torch.zeros_like(alpha))
    before = _light_before(alpha)
    return torch.where(before >= TRANSMITTANCE_MIN, alpha, torch.zeros_like(alpha))


def _light_before(alpha: Tensor) -> Tensor:
    through = torch.cumprod(1 - alpha, 0)
    return torch.cat([torch.ones_like(through[:1]), through[:-1]])


def weights_of(alpha: Tensor) -> tuple[Tensor, Tensor]:
    """([M, P] blend weights, [P] transmittance that is left) of alphas, nearest first."""
    return alpha * _light_before(alpha), (1 - alpha).prod(0)


def blend_weights(
    projected: Projected, rows: Tensor, pixels: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """([M, P] blend weights, [P] transmittance that is left, [P] median depth) of splats `rows` at
    pixel centres [P, 2]."""
    alpha = alphas_at(projected, rows, pixels)
    weights, passed = weights_of(alpha)
    before = _light_before(alpha)
    halved = (before >= 0.5) & (before * (1 - alpha) < 0.5)  # once at most
    return weights, passed, (halved * projected.depths[rows][:, None]).sum(0)


def render_tensors(
    p: Parameters, camera: Camera, settings: RasterSettings, smoothing: Tensor | None = None
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """(image [H, W, 3], alpha, expected depth, median depth [H, W]), differentiable in `p`."""
    return render_projected(p, project(p, camera, settings, smoothing), camera, settings)


def render_projected(
    p: Parameters, projected: Projected, camera: Camera, settings: RasterSettings
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The result of `render_tensors`, from given footprints."""
    like: dict[str, Any] = {"dtype": p.means.dtype, "device": p.means.device}
    centre = torch.tensor(camera.centre, **like)
    rgb = colours(p.rows(projected.index), centre, settings.sh_degree)
    background = torch.tensor(settings.background, **like)
    image = torch.zeros(camera.height, camera.width, 3, **like)
    alpha = torch.zeros(camera.height, camera.width, **like)
    depth = torch.zeros(camera.height, camera.width, **like)
    median = torch.zeros(camera.height, camera.width, **like)
    for (top, bottom, left, right), rows, pixels in picture_blocks(projected, camera):
        weights, passed, halfway = blend_weights(projected, rows, pixels)
        shape = (bottom - top, right - left)
        colour = weights.T @ rgb[rows] + passed[:, None] * background
        image[top:bottom, left:right] = colour.reshape(*shape, 3)
        hit = weights.sum(0)
        alpha[top:bottom, left:right] = (1 - passed).reshape(shape)
        mean_depth = (weights.T @ projected.depths[rows]) / hit.clamp_min(ALPHA_MIN / 2)
        depth[top:bottom, left:right] = mean_depth.reshape(shape)
        median[top:bottom, left:right] = halfway.reshape(shape)
    return image, alpha, depth, median


def boxes(projected: Projected) -> tuple[Tensor, Tensor]:
    """([M, 2] low, [M, 2] high): the box in pixels outside which a splat's alpha is below 1/255."""
    reach = (2 * torch.log(255 * projected.opacities.detach())).clamp_min(0).sqrt()
    extent = torch.stack([projected.a, projected.c], 1).detach().sqrt() * reach[:, None]
    return projected.means2d.detach() - extent, projected.means2d.detach() + extent


def picture_blocks(
    projected: Projected, camera: Camera
) -> Iterator[tuple[tuple[int, int, int, int], Tensor, Tensor]]:
    """The picture in blocks, in strips where a block holds many splats: ((top, bottom, left,
    right), rows of `projected` that can touch the block, nearest first, pixel centres [P, 2])."""
    like: dict[str, Any] = {"dtype": projected.depths.dtype, "device": projected.depths.device}
    low, high = boxes(projected)
    for top in range(0, camera.height, BLOCK):
        for left in range(0, camera.width, BLOCK):
            bottom, right = min(top + BLOCK, camera.height), min(left + BLOCK, camera.width)
            corner, end = torch.tensor([left, top], **like), torch.tensor([right, bottom], **like)
            rows = ((high >= corner) & (low <= end)).all(1).nonzero()[:, 0]
            lines = max(1, MOST // max(1, len(rows) * (right - left)))
            for first in range(top, bottom, lines):
                last = min(first + lines, bottom)
                ys, xs = torch.meshgrid(
                    torch.arange(first, last, **like) + 0.5,
                    torch.arange(left, right, **like) + 0.5,
                    indexing="ij",
                )
                yield (first, last, left, right), rows, torch.stack([xs, ys], -1).flatten(0, 1)
