"""What removing one splat would do to the squared error, against drawing without it."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from stages.raster.backends import rasteriser_of
from stages.raster.definition import (
    CONTRIBUTIONS,
    ERROR_CHANGE,
    LARGEST_WEIGHT,
    PICTURE_CHANGE,
    SQUARED_WEIGHT,
    WEIGHT,
    WEIGHTED_RESIDUAL,
    RasterSettings,
    splat_arrays,
)
from stages.raster.reference import blend_weights, parameters_of, project, render_tensors
from tests.scenes import BACKENDS, LIGHT_BACKENDS, camera, cloud, relative, splats

SETTINGS = RasterSettings(background=(0.2, 0.5, 0.9), sh_degree=2)


def faint_cloud(seed=0, n=60):
    """So faint that no pixel reaches the stopping rule."""
    scene = cloud(n, 40, 30, seed=seed, size_px=5.0)
    logits = np.random.default_rng(seed).uniform(-3, 0.5, n).astype(np.float32)
    return replace(scene, opacity_logits=logits)


def photograph(seed=5):
    return np.random.default_rng(seed).uniform(0, 1, (3, 30, 40)).astype(np.float32)


def measured(backend, scene, picture, where, settings=SETTINGS):
    """[N, CONTRIBUTIONS] of `contributions`, zero for what is out of view."""
    rasteriser = rasteriser_of(backend)
    forward = rasteriser.forward(splat_arrays(scene), where, settings)
    residual = np.ascontiguousarray(forward.image[:3] - picture)
    full = np.zeros((len(scene), CONTRIBUTIONS))
    full[forward.visible] = rasteriser.contributions(forward, residual)
    return full


def squared_error(scene, picture, where):
    """In float64, by the definition."""
    image, _, _, _ = render_tensors(parameters_of(scene), where, SETTINGS)
    return float(
        ((image.detach().numpy().transpose(2, 0, 1) - picture.astype(np.float64)) ** 2).sum()
    )


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("seed", range(3))
def test_the_change_of_the_error_is_that_of_drawing_without_the_splat(backend, seed):
    scene, where, picture = faint_cloud(seed), camera(40, 30), photograph()
    now = squared_error(scene, picture, where)
    rows = np.arange(len(scene))
    wanted = np.array([squared_error(scene.take(rows != i), picture, where) - now for i in rows])
    assert (wanted < 0).any()
    assert (wanted > 0).any()
    assert relative(measured(backend, scene, picture, where)[:, ERROR_CHANGE], wanted) < 1e-3


@pytest.mark.parametrize("backend", LIGHT_BACKENDS)
def test_against_its_own_picture_no_splat_is_better_gone(backend):
    scene, where = faint_cloud(1), camera(40, 30)
    forward = rasteriser_of(backend).forward(splat_arrays(scene), where, SETTINGS)
    found = measured(backend, scene, forward.image[:3].copy(), where)
    assert (found[:, ERROR_CHANGE] >= 0).all()
    np.testing.assert_array_equal(found[:, PICTURE_CHANGE], found[:, ERROR_CHANGE])
    other = measured(backend, scene, photograph(), where)
    np.testing.assert_array_equal(other[:, PICTURE_CHANGE], found[:, PICTURE_CHANGE])


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("opaque", [False, True])
def test_weights_are_those_of_the_definition(backend, opaque):
    scene = cloud(200, 40, 30, size_px=8.0) if opaque else faint_cloud()
    where = camera(40, 30)
    projected = project(parameters_of(scene), where, SETTINGS)
    ys, xs = torch.meshgrid(
        torch.arange(30, dtype=torch.float64) + 0.5,
        torch.arange(40, dtype=torch.float64) + 0.5,
        indexing="ij",
    )
    pixels = torch.stack([xs, ys], -1).flatten(0, 1)
    with torch.no_grad():
        weights, _, _ = blend_weights(projected, torch.arange(len(projected.depths)), pixels)
    image, _, _, _ = render_tensors(parameters_of(scene), where, SETTINGS)
    residual = (image.detach() - torch.tensor(photograph().transpose(1, 2, 0))).flatten(0, 1)
    columns = [weights.sum(1), weights.amax(1), weights.square().sum(1), *(weights @ residual).T]
    wanted = np.zeros((len(scene), 6))
    wanted[projected.index.numpy()] = torch.stack(columns, 1).numpy()
    found = measured(backend, scene, photograph(), where)
    np.testing.assert_allclose(found[:, LARGEST_WEIGHT], wanted[:, 1], atol=5e-3)
    assert relative(found[:, WEIGHT], wanted[:, 0]) < 1e-3
    assert relative(found[:, SQUARED_WEIGHT], wanted[:, 2]) < 1e-3
    assert relative(found[:, WEIGHTED_RESIDUAL:], wanted[:, 3:]) < 1e-3


@pytest.mark.parametrize("backend", LIGHT_BACKENDS)
def test_a_worked_pixel(backend):
    """A wide splat of opacity 1/2 and colour 1 on black, the photograph black as well: at its
    centre the picture is 1/2, and taking it out takes (1/2)^2 a channel away."""
    scene = splats([[0.0, 0.0, 1.0]], scales=1000.0, opacities=0.5, rgb=(1.0, 1.0, 1.0))
    black = np.zeros((3, 1, 1), np.float32)
    found = measured(
        backend, scene, black, camera(1, 1), replace(SETTINGS, background=(0.0, 0.0, 0.0))
    )
    np.testing.assert_allclose(found, [[-0.75, 0.75, 0.5, 0.5, 0.25, 0.25, 0.25, 0.25]], rtol=1e-4)
