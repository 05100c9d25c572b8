"""L1 + SSIM and its gradient against float64 autograd, and where single precision would fail."""

import numpy as np
import pytest
import torch

from stages.evaluate.image_metrics import psnr, ssim
from stages.raster.kernels.pool import Pool
from stages.train.loss import image_loss
from tests.tolerances import LOSS_GRADIENT
from tests.train.float64_loss import reference


@pytest.mark.parametrize("exposure", [1.0, 100.0])
@pytest.mark.parametrize("size", [(1, 1), (1, 17), (33, 47), (130, 200)])
def test_value_and_gradient_are_those_of_float64(size, exposure):
    r = np.random.default_rng(0)
    target = (r.uniform(0, 1, (3, *size)) * exposure).astype(np.float32)
    image = (target + r.normal(0, 0.1 * exposure, target.shape)).astype(np.float32)
    v_image = np.full((3, *size), np.nan, np.float32)
    loss = image_loss(Pool(2), image, target, v_image)
    x = torch.tensor(image, dtype=torch.float64, requires_grad=True)
    value, score = reference(x, torch.tensor(target, dtype=torch.float64))
    value.backward()
    assert x.grad is not None
    wanted = x.grad.numpy() * size[0] * size[1]
    assert loss.value == pytest.approx(float(value.detach()), rel=1e-6)
    assert loss.ssim == pytest.approx(float(score.detach()), abs=1e-6)
    assert np.abs(v_image - wanted).max() <= LOSS_GRADIENT * np.abs(wanted).max()


@pytest.mark.parametrize("level", [0.6, 1.0, 100.0])
def test_nearly_equal_flat_pictures_have_ssim_one(level):
    target = np.full((3, 40, 40), level, np.float32)
    image = target + np.float32(1e-7)
    loss = image_loss(Pool(1), image, target, np.empty_like(target))
    assert -1 <= loss.ssim <= 1 + 1e-6
    assert loss.ssim == pytest.approx(1.0, abs=1e-6)


def test_equal_pictures_have_no_gradient():
    target = np.random.default_rng(0).uniform(0, 1, (3, 30, 50)).astype(np.float32)
    v_image = np.empty_like(target)
    loss = image_loss(Pool(2), target.copy(), target, v_image)
    assert loss.l1 == 0
    assert np.abs(v_image).max() < 1e-5


def test_the_result_does_not_depend_on_the_number_of_threads():
    r = np.random.default_rng(0)
    image, target = r.uniform(0, 1, (2, 3, 150, 90)).astype(np.float32)
    results = []
    for threads in (1, 2, 3):
        v_image = np.empty_like(target)
        results.append((image_loss(Pool(threads), image, target, v_image).value, v_image))
    for value, v_image in results[1:]:
        assert value == results[0][0]
        np.testing.assert_array_equal(v_image, results[0][1])


def test_psnr_and_ssim_of_known_pictures():
    grey = np.full((20, 20, 3), 0.5, np.float32)
    assert psnr(grey, grey + 0.1) == pytest.approx(20.0, abs=1e-5)
    assert psnr(grey, grey) == np.inf
    assert ssim(grey, grey) == pytest.approx(1.0)
    noise = np.random.default_rng(0).uniform(0, 1, (64, 64, 3))
    assert ssim(noise, 1 - noise) < 0
