"""Adam on the splats that a step has seen."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

from stages.raster.definition import MEAN, ROTATION, Backward, gradient_columns, used_columns
from stages.raster.kernels.pool import Pool
from stages.scene import look_at
from stages.train.optimiser import (
    EPSILON,
    LEAST_DISTANCE,
    LearningRates,
    apply_gradients,
    bias_corrections,
    camera_distances,
    new_model,
)
from stages.train.steps.reference import update
from tests.scenes import camera

RATES = LearningRates(means=0.01)


def model(n=5, coefficients=4, seed=0):
    r = np.random.default_rng(seed)
    shapes = ((n, 3), (n, 4), (n, 3), (n,), (n, coefficients, 3))
    return new_model(*(r.normal(size=s).astype(np.float32) for s in shapes))


def backward(rows, coefficients, seed=1, scale=1.0):
    r = np.random.default_rng(seed)
    values = np.zeros((len(rows), gradient_columns(coefficients)), np.float32)
    values[:, : used_columns(coefficients)] = (
        r.normal(size=(len(rows), used_columns(coefficients))) * scale
    )
    means2d = r.normal(size=(len(rows), 2)).astype(np.float32)
    return Backward(np.asarray(rows, np.int32), values, means2d)


def apply(m, b, coefficients=4):
    apply_gradients(Pool(1), m, b, coefficients, RATES, 100, 50)


def test_many_steps_are_those_of_torch():
    """With every splat in view."""
    m = model()
    columns = used_columns(4)
    start = np.concatenate([a.reshape(5, -1) for a in m.arrays], 1)
    p = torch.tensor(start, dtype=torch.float64, requires_grad=True)
    rates = RATES.row(4)[:columns]
    groups = [p[:, k].detach().clone().requires_grad_() for k in range(columns)]
    adam = torch.optim.Adam(
        [{"params": [g], "lr": float(lr)} for g, lr in zip(groups, rates, strict=True)],
        eps=EPSILON,
    )
    for step in range(50):
        b = backward(range(5), 4, seed=step)
        for k, g in enumerate(groups):
            g.grad = torch.tensor(b.parameters[:, k], dtype=torch.float64)
        adam.step()
        apply(m, b)
    found = np.concatenate([a.reshape(5, -1) for a in m.arrays], 1)
    wanted = torch.stack(groups, 1).detach().numpy()
    np.testing.assert_allclose(found, wanted, atol=2e-5)  # 50 roundings of values up to 4
    assert m.gradient_count.sum() == 250


def test_the_first_step_of_a_splat_first_seen_late_is_its_rate():
    m = model(2)
    for step in range(1000):
        apply(m, backward([0], 4, seed=step))
    before = m.means[1].copy()
    apply(m, backward([1], 4, seed=7, scale=100.0))  # far above EPSILON
    np.testing.assert_allclose(np.abs(m.means[1] - before), RATES.means, rtol=0.01)


def test_a_mean_moves_in_proportion_to_its_distance_from_the_nearest_camera():
    """So that it moves as far in that camera's picture, wherever it is."""
    m = model(3)
    m.distances[:] = 0.5, 1.0, 20.0
    before = {name: array.copy() for name, array in vars(m).items()}
    apply(m, backward([0, 1, 2], 4, scale=100.0))
    moved = np.abs(m.means - before["means"])
    np.testing.assert_allclose(moved, RATES.means * m.distances[:, None] * np.ones(3), rtol=0.01)
    turned = np.abs(m.quaternions - before["quaternions"])
    np.testing.assert_allclose(turned, RATES.quaternions, rtol=0.01)


def test_distances_are_to_the_nearest_camera_in_extents_of_the_scene():
    ahead = np.array([0, 0, 1.0])
    cameras = [camera(4, 4, matrix=look_at(at, at + ahead)) for at in np.diag([0.0, 6.0, 0.0])]
    means = np.array([[0, 0, 5], [0, 6, 0.01], [0, 3, 400], [np.nan, 0, 0]], np.float32)
    found = camera_distances(means, cameras, extent=2.0)
    np.testing.assert_allclose(found, [2.5, LEAST_DISTANCE, 200.0056, 1.0], rtol=1e-5)
    in_millimetres = [
        replace(one, world_to_camera=scaled_pose(one.world_to_camera, 1000)) for one in cameras
    ]
    same = camera_distances(1000 * means, in_millimetres, extent=2000.0)
    np.testing.assert_allclose(same, found, rtol=1e-5)
    assert (camera_distances(means, [], extent=2.0) == 1).all()


def scaled_pose(pose, by):
    moved = pose.copy()
    moved[:3, 3] *= by
    return moved


def test_splats_out_of_view_and_broken_gradients_change_nothing():
    m, untouched = model(), model()
    b = backward([1, 3], 4)
    b.parameters[1, 5] = np.nan
    apply(m, b)
    for found, wanted in zip(m.arrays, untouched.arrays, strict=True):
        np.testing.assert_array_equal(found[[0, 2, 3, 4]], wanted[[0, 2, 3, 4]])
        assert (found[1] != wanted[1]).all()
    assert m.steps.max(1).tolist() == [0, 1, 0, 0, 0]


@pytest.mark.parametrize("unit", [1e-6, 1e6])
@pytest.mark.parametrize("scale", [1e-5, 1.0, 1e11])  # far below EPSILON, and near the largest
def test_a_step_does_not_depend_on_the_unit_of_length(unit, scale):
    def moved(unit, step):
        m, b, means = model(), backward(range(5), 4, scale=scale), slice(MEAN, ROTATION)
        m.means[:] = 0
        b.parameters[:, means] /= unit
        step(m, b, 4, RATES.scaled(0.01 * unit, 1.0, unit), 100, 50)
        return m.means / unit

    for step in (partial(apply_gradients, Pool(1)), update):
        wanted = moved(1.0, step)
        assert wanted.any()
        np.testing.assert_allclose(moved(unit, step), wanted, rtol=1e-4)


def test_sh_coefficients_that_are_not_trained_yet_stay_zero():
    m = model(3, coefficients=9)
    m.sh[:, 4:] = 0
    apply(m, backward(range(3), 4), coefficients=4)
    assert not m.sh[:, 4:].any()


def test_noise_far_below_any_signal_hardly_moves_a_splat():
    """1e-10 in the units of the mean loss of a picture of 150,000 pixels."""
    m = model(1)
    before = m.means.copy()
    for step in range(300):
        apply(m, backward([0], 4, seed=step, scale=1e-10 * 150_000))
    assert np.abs(m.means - before).max() < 5 * RATES.means


def test_the_optimiser_state_is_less_than_a_third_of_the_memory():
    """Parameters, a gradient and two moments are 4 x 236 bytes at degree 3."""
    m = model(10, coefficients=16)
    remembered = sum(array.nbytes for array in vars(m).values()) + 10 * 4 * gradient_columns(16)
    assert remembered <= 1.3 * 10 * 4 * 236


def test_bias_corrections_end_at_one():
    table = bias_corrections()
    assert table[1, 0] == pytest.approx(10.0)
    assert table[1, 1] == pytest.approx(1000.0, rel=1e-5)
    assert (table[-1] == 1.0).all()
