"""Small scenes whose answers are known, and how to get gradients of any backend."""

from __future__ import annotations

import importlib.util
from typing import Any

import numpy as np

from stages.raster import backends
from stages.raster.definition import (
    LOG_SCALE,
    MEAN,
    OPACITY,
    ROTATION,
    SH,
    RasterSettings,
    splat_arrays,
    used_columns,
)
from stages.raster.draw import rendering_of
from stages.scene import Camera, Splats, logit, rgb_to_dc

# Those that run everywhere. What they are held to, tests/raster/test_gpu.py holds the GPU's to.
BACKENDS = tuple(backend.name for backend in backends.BACKENDS if not backend.needs_hardware)
# Of laws small enough for Triton's interpreter, which takes the GPU's part where there is none.
_INTERPRETED = "gpu" not in BACKENDS and importlib.util.find_spec("triton") is not None
LIGHT_BACKENDS = (*BACKENDS, "gpu") if _INTERPRETED else BACKENDS


def camera(width=64, height=48, focal=60.0, cx=None, cy=None, matrix=None):
    """A pinhole camera, at the origin and looking along +z by default."""
    return Camera(
        width,
        height,
        focal,
        focal,
        width / 2 if cx is None else cx,
        height / 2 if cy is None else cy,
        np.eye(4) if matrix is None else matrix,
    )


def splats(means, scales=0.1, opacities=0.5, rgb=(1.0, 0.5, 0.25), quaternions=(1, 0, 0, 0)):
    """Splats of degree 0; everything but `means` is broadcast."""
    means = np.atleast_2d(np.asarray(means, np.float32))
    n = len(means)
    with np.errstate(all="ignore"):
        log_scales = np.log(np.broadcast_to(np.asarray(scales, np.float64), (n, 3)))
    return Splats(
        means=means,
        quaternions=np.broadcast_to(np.asarray(quaternions, np.float32), (n, 4)).copy(),
        log_scales=log_scales.astype(np.float32),
        opacity_logits=logit(np.broadcast_to(np.asarray(opacities, np.float64), (n,))).astype(
            np.float32
        ),
        sh=rgb_to_dc(np.broadcast_to(np.asarray(rgb, np.float32), (n, 3)))[:, None].astype(
            np.float32
        ),
        sh_degrees=np.zeros(n, np.uint8),
    )


def cloud(n, width=64, height=48, degree=2, seed=0, size_px=3.0, spread=0.5):
    """n random splats in and around the view of `camera(width, height)`."""
    r = np.random.default_rng(seed)
    focal = 60.0
    z = r.uniform(2, 6, n)
    u, v = r.uniform(-8, width + 8, n), r.uniform(-8, height + 8, n)
    means = np.stack([(u - width / 2) * z / focal, (v - height / 2) * z / focal, z], 1)
    scales = (size_px * z / focal)[:, None] * np.exp(r.normal(0, spread, (n, 3)))
    return Splats(
        means.astype(np.float32),
        r.normal(size=(n, 4)).astype(np.float32),
        np.log(scales).astype(np.float32),
        r.normal(0, 2, n).astype(np.float32),
        r.normal(0, 0.5, (n, (degree + 1) ** 2, 3)).astype(np.float32),
        np.full(n, degree, np.uint8),
    )


def join(*parts):
    """One set of splats from several."""
    names = ("means", "quaternions", "log_scales", "opacity_logits", "sh", "sh_degrees")
    degree = max(p.sh_degree for p in parts)
    equal = [p.with_sh_degree(degree) for p in parts]
    arrays: dict[str, Any] = {n: np.concatenate([getattr(p, n) for p in equal]) for n in names}
    return Splats(**arrays)


PARAMETERS = ("means", "quaternions", "log_scales", "opacity_logits", "sh")


def render_filtered(scene, view, settings, backend, widths):
    """As `raster.draw.render`, under 3D smoothing filters of `widths` [N], as training draws."""
    arrays = (*splat_arrays(scene), widths)
    forward = backends.rasteriser_of(backend).forward(arrays, view, settings, depths=True)
    return rendering_of(forward)


def gradients(backend, scene, view, v_image, settings=None, smoothing=None):
    """{parameter: gradient of sum(image x v_image)}, each in the shape of its parameter, as the
    backend of that name gives them."""
    settings = settings or RasterSettings()
    rasteriser = backends.rasteriser_of(backend)
    arrays = splat_arrays(scene) if smoothing is None else (*splat_arrays(scene), smoothing)
    forward = rasteriser.forward(arrays, view, settings)
    poison(rasteriser)
    planar = np.ascontiguousarray(np.asarray(v_image, np.float32).transpose(2, 0, 1))
    found = rasteriser.backward(forward, planar)
    full = np.zeros((len(scene), found.parameters.shape[1]))
    full[found.rows] = found.parameters
    coefficients = (min(settings.sh_degree, scene.sh_degree) + 1) ** 2
    sh = np.zeros(scene.sh.shape)
    sh[:, :coefficients] = full[:, SH : used_columns(coefficients)].reshape(
        len(scene), coefficients, 3
    )
    return {
        "means": full[:, MEAN:ROTATION],
        "quaternions": full[:, ROTATION:LOG_SCALE],
        "log_scales": full[:, LOG_SCALE:OPACITY],
        "opacity_logits": full[:, OPACITY],
        "sh": sh,
    }


def poison(rasteriser):
    """What buffers held before must not matter."""
    buffers = getattr(rasteriser, "buffers", None)
    if buffers is not None:
        buffers.get("out", (4_000_000,), np.float32)[:] = np.nan
        buffers.carve(((4_000_000,), np.float32))[0][:] = np.nan


def exact_gradients(scene, view, v_image, settings=None, smoothing=None):
    """As `gradients`, in float64 by autograd through the definition: what backends are held to."""
    import torch

    from stages.raster.reference import parameters_of, render_tensors

    p = parameters_of(scene)
    widths = None if smoothing is None else torch.tensor(smoothing, dtype=torch.float64)
    image, _, _, _ = render_tensors(p, view, settings or RasterSettings(), widths)
    if image.requires_grad:
        image.backward(torch.tensor(np.asarray(v_image, np.float64)))
    return {
        name: np.zeros(t.shape) if t.grad is None else t.grad.numpy()
        for name, t in zip(PARAMETERS, p.tensors(), strict=True)
    }


def relative(found, wanted):
    """Largest difference over the largest wanted value."""
    top = max(float(np.abs(wanted).max()), 1e-30) if wanted.size else 1.0
    return float(np.abs(found - wanted).max() / top) if wanted.size else 0.0


def textbook_alpha(scene, view, row=0, dilation=0.3):
    """[H, W] opacity x exp(-1/2 d^T cov^-1 d) of one splat, by the textbook, in extended
    precision: no Cholesky form, no minors, no tiles."""
    L = np.longdouble
    w, x, y, z = (scene.quaternions[row].astype(L)) / np.sqrt(
        (scene.quaternions[row].astype(L) ** 2).sum()
    )
    R = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ],
        L,
    )
    W, t = view.world_to_camera[:3, :3].astype(L), view.world_to_camera[:3, 3].astype(L)
    at = W @ scene.means[row].astype(L) + t
    fx, fy = L(view.fx), L(view.fy)
    J = np.array(
        [[fx / at[2], 0, -fx * at[0] / at[2] ** 2], [0, fy / at[2], -fy * at[1] / at[2] ** 2]], L
    )
    V = J @ W @ R @ np.diag(np.exp(scene.log_scales[row].astype(L)))
    cov = V @ V.T + L(dilation) * np.eye(2, dtype=L)
    det = cov[0, 0] * cov[1, 1] - cov[0, 1] ** 2
    mean = np.array([fx * at[0] / at[2] + L(view.cx), fy * at[1] / at[2] + L(view.cy)])
    ys, xs = np.mgrid[: view.height, : view.width].astype(L) + L(0.5)
    dx, dy = xs - mean[0], ys - mean[1]
    power = (cov[1, 1] * dx * dx - 2 * cov[0, 1] * dx * dy + cov[0, 0] * dy * dy) / det / 2
    opacity = 1 / (1 + np.exp(-scene.opacity_logits[row].astype(L)))
    alpha = np.minimum(opacity * np.exp(-power), L(0.99))
    return np.where(alpha >= L(1) / 255, alpha, 0).astype(np.float64)
