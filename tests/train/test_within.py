"""A block is densified in its own rectangle, and keeps the splats around it."""

from __future__ import annotations

import numpy as np
import pytest

from stages.train.density import GRADIENT_THRESHOLD, AdaptiveDensity, BoundedDensity, cull
from stages.train.optimiser import Model, new_model


@pytest.fixture
def model() -> Model:
    """Four splats at x = -2, -1, 1, 2, all of them wanted more of; those farthest out large."""
    n = 4
    means = np.array([[x, 5.0, 0.0] for x in (-2, -1, 1, 2)], np.float32)
    sizes = np.log(np.array([2.0, 0.001, 0.001, 2.0], np.float32))
    found = new_model(
        means,
        np.tile(np.array([1, 0, 0, 0], np.float32), (n, 1)),
        np.repeat(sizes[:, None], 3, axis=1),
        np.zeros(n, np.float32),
        np.zeros((n, 1, 3), np.float32),
    )
    found.gradient_sum[:], found.gradient_count[:] = 10 * GRADIENT_THRESHOLD, 1
    return found


BLOCK = BoundedDensity(AdaptiveDensity(views=8), (0.0, -9.0, 9.0, 9.0))


def test_a_block_is_densified_only_in_its_own_rectangle(model) -> None:
    grown = BLOCK.grow(model.take(np.arange(3)), 100)
    assert np.sort(grown.means[:, 0]) == pytest.approx([-2, -1, 1, 1], abs=0.01)


def test_transparent_splats_are_removed_everywhere(model) -> None:
    model.opacity_logits[1:3] = -20.0
    assert sorted(cull(model).means[:, 0]) == [-2, 2]
