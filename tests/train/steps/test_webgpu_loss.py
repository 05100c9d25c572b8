"""The loss on a WebGPU device, which a program on the CPU may play."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from stages.raster.webgpu import device
from stages.raster.webgpu.device import Buffers
from stages.scene import IGNORE, TRANSPARENT
from stages.train.loss import channel_means
from stages.train.steps.reference import compared, reference_loss
from stages.train.steps.webgpu_loss import Loss, loss_of, photograph_of
from stages.train.views import Level
from tests.scenes import camera
from tests.tolerances import LOSS_GRADIENT

pytestmark = pytest.mark.skipif(bool(device.missing()), reason=device.missing())
LIGHT, BACKGROUND = (0.3, -0.2, 0.1), (0.2, 0.9, 0.4)


@pytest.mark.parametrize("size", [(1, 1), (17, 3), (47, 33)])
@pytest.mark.parametrize(
    ("outside", "light"),
    [("", None), (IGNORE, None), (TRANSPARENT, LIGHT), (IGNORE, LIGHT)],
)
def test_the_loss_and_its_gradient_are_those_of_the_definition(size, outside, light):
    random = np.random.default_rng(1)
    pixels = random.integers(0, 256, (3, size[1], size[0])).astype(np.uint8)
    mask = np.where(random.random(size[::-1]) < 0.6, 255, 0).astype(np.uint8) if outside else None
    level = Level(camera(*size), pixels, channel_means(pixels), mask, outside, light)
    image = random.random((4, size[1], size[0])).astype(np.float32)
    gpu, weight = device.require(), 2.0
    loss = Loss(Buffers(gpu))
    photograph = photograph_of(level, gpu)
    v_image = loss.gradient(gpu.sent(image), photograph, level, BACKGROUND, weight)
    found = gpu.read(v_image, np.float32, pixels.size).reshape(pixels.shape)
    exact = torch.tensor(image[:3], dtype=torch.float64, requires_grad=True)
    wanted = reference_loss(*compared(level, exact, BACKGROUND))
    torch.autograd.backward(weight * size[0] * size[1] * wanted)
    assert exact.grad is not None
    value = loss_of(gpu.read(loss.sums, np.float32, 5))
    assert value == pytest.approx(float(wanted.detach()), abs=1e-6)
    top = max(float(exact.grad.abs().max()), 1e-9)
    assert np.abs(found - exact.grad.numpy()).max() <= LOSS_GRADIENT * top
