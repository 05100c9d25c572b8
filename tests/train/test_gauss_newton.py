"""Steps by the diagonal of J^T J: how it is measured, and how far it lets a parameter move."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from stages.base.stage import Report
from stages.raster.cpu.rasteriser import CpuRasteriser
from stages.raster.definition import (
    MEAN,
    ROTATION,
    Backward,
    RasterSettings,
    gradient_columns,
    splat_arrays,
    used_columns,
)
from stages.raster.kernels.pool import Pool
from stages.raster.webgpu import device
from stages.scene import DrawSettings
from stages.train.gauss_newton import CURVATURE_DECAY, INTERVAL, sign_picture
from stages.train.hooks import Curvature
from stages.train.optimiser import (
    EPSILON,
    LARGEST_GRADIENT,
    LearningRates,
    Model,
    apply_gradients,
    measure_curvature,
    new_model,
)
from stages.train.random_bits import hashed, signs
from stages.train.schedule import DENSIFICATION_END, DENSIFYING_PART, LAST_PART, Schedule
from tests.scenes import camera, cloud
from tests.train.pictures import trainer_of, view_of

RATES = LearningRates(means=0.01)
USED = used_columns(4)
DAMPED = 300.0


def model(n: int = 3) -> Model:
    r = np.random.default_rng(0)
    shapes = ((n, 3), (n, 4), (n, 3), (n,), (n, 4, 3))
    return new_model(*(r.normal(size=shape).astype(np.float32) for shape in shapes))


def backward(values: NDArray[np.floating]) -> Backward:
    """Of splats 0, 1, ..., with gradients [M] that are those of all their parameters."""
    rows = np.arange(len(values), dtype=np.int32)
    parameters = np.zeros((len(values), gradient_columns(4)), np.float32)
    parameters[:, :USED] = values[:, None]
    return Backward(rows, parameters, np.zeros((len(values), 2), np.float32))


def moved(m: Model, gradients: NDArray[np.floating]) -> NDArray[np.floating]:
    """[M, USED] by how much one step lowers each parameter."""
    before = np.concatenate([array.reshape(len(m), -1) for array in m.arrays], 1)
    apply_gradients(Pool(1), m, backward(gradients), 4, RATES, 100, 50, damping=DAMPED)
    after = np.concatenate([array.reshape(len(m), -1) for array in m.arrays], 1)
    return (before - after)[: len(gradients)]


def test_half_of_the_signs_are_positive_and_none_depends_on_another() -> None:
    first, second = signs((1 << 16,), 1), signs((1 << 16,), 2)
    error = 2.0**-8  # of the mean of so many
    assert set(np.unique(first)) == {-1.0, 1.0}
    for product in (
        first,
        second,
        first * second,
        first[1:] * first[:-1],
        first[32:] * first[:-32],
    ):
        assert abs(product.mean()) < 4 * error


def test_a_sign_is_one_bit_of_the_hash_of_its_word() -> None:
    found = signs((2, 50), 7).ravel()
    words = hashed(np.arange(4, dtype=np.uint32), 7)
    assert [1 if int(words[k // 32]) >> (k % 32) & 1 else -1 for k in range(100)] == found.tolist()


def test_the_mean_square_is_the_diagonal_of_the_gauss_newton_matrix() -> None:
    """By the derivatives of every value of a small picture."""
    where, settings = camera(9, 7), RasterSettings(near=0.1, sh_degree=1)
    arrays = splat_arrays(cloud(12, 9, 7, degree=1, seed=3))
    rasteriser = CpuRasteriser()
    forward = rasteriser.forward(arrays, where, settings)

    def derivatives(picture: NDArray[np.float32]) -> NDArray[np.float64]:
        return rasteriser.backward(forward, picture).parameters.astype(np.float64)

    values = 3 * 9 * 7
    one_hot = np.eye(values, dtype=np.float32).reshape(values, 3, 7, 9)
    diagonal = np.sum([derivatives(picture) ** 2 for picture in one_hot], axis=0)
    keys = 4000
    squares = [derivatives(sign_picture((3, 7, 9), key, 1.0)) ** 2 for key in range(keys)]
    found, error = np.mean(squares, axis=0), np.std(squares, axis=0) / keys**0.5
    assert diagonal.any()
    assert (np.abs(found - diagonal) <= 5 * error + 1e-6 * diagonal.max()).all()


def test_a_weight_multiplies_the_curvature_as_it_does_the_gradients() -> None:
    plain, weighted = (sign_picture((3, 4, 5), 7, weight) for weight in (1.0, 16.0))
    np.testing.assert_array_equal(weighted**2, 16.0 * plain**2)


def test_the_first_measurement_counts_whole_and_later_ones_are_averaged() -> None:
    m = model(2)
    for value in (2.0, 4.0):
        measure_curvature(Pool(1), m, backward(np.array([value])), extent=3.0)
    wanted = CURVATURE_DECAY * 4.0 + (1 - CURVATURE_DECAY) * 16.0
    np.testing.assert_allclose(m.moment2[0, ROTATION:USED], wanted, rtol=1e-6)
    np.testing.assert_allclose(m.moment2[0, MEAN:ROTATION], 9.0 * wanted, rtol=1e-6)  # per extent
    assert not m.moment2[1].any()


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 2 * LARGEST_GRADIENT])
def test_a_broken_derivative_leaves_the_curvature_of_its_splat(value: float) -> None:
    m = model(2)
    measure_curvature(Pool(1), m, backward(np.array([1.0, 1.0])), extent=1.0)
    broken = backward(np.array([5.0, 5.0]))
    broken.parameters[0, 7] = value
    measure_curvature(Pool(1), m, broken, extent=1.0)
    assert (m.moment2[0, :USED] == 1.0).all()
    assert (m.moment2[1, :USED] > 1.0).all()


def test_a_parameter_does_not_move_before_its_curvature_is_known() -> None:
    m = model()
    assert not moved(m, np.array([1.0, -5.0, 1e6])).any()
    measure_curvature(Pool(1), m, backward(np.array([1.0])), extent=1.0)
    found = moved(m, np.array([1.0, -5.0, 1e6]))
    assert found[0].all()
    assert not found[1:].any()


@pytest.mark.parametrize("root", [1e-6, 1e-3, 1.0, 1e3, 1e12])
def test_a_step_is_the_damped_newton_step_and_at_most_the_learning_rate(root: float) -> None:
    m, gradients = model(), np.array([0.5, -0.5, 1e9])
    m.distances[:] = 0.5, 1.0, 20.0
    measure_curvature(Pool(1), m, backward(np.full(3, root)), extent=1.0)
    found = moved(m, gradients)
    rate = np.tile(RATES.row(4)[:USED], (3, 1)).astype(np.float64)
    rate[:, MEAN:ROTATION] *= m.distances[:, None]
    newton = rate * gradients[:, None] / (DAMPED * root**2 * rate + EPSILON)
    np.testing.assert_allclose(found, np.clip(newton, -rate, rate), rtol=1e-4, atol=3e-7)


def test_noise_far_below_any_signal_hardly_moves_a_splat() -> None:
    """Gradients and derivatives of 1e-10 in the units of the mean loss of 150,000 pixels."""
    m, r, noise = model(1), np.random.default_rng(0), 1e-10 * 150_000
    before = np.concatenate([array.reshape(-1) for array in m.arrays])
    for _ in range(300):
        measure_curvature(Pool(1), m, backward(noise * r.normal(size=1)), extent=1.0)
        moved(m, noise * r.normal(size=1))
    after = np.concatenate([array.reshape(-1) for array in m.arrays])
    assert (np.abs(after - before) < 5 * RATES.row(4)[:USED]).all()


@pytest.mark.parametrize("unit", [1e-6, 1e6])
@pytest.mark.parametrize("scale", [1e-5, 1.0, 1e11])
def test_a_step_does_not_depend_on_the_unit_of_length(unit: float, scale: float) -> None:
    def of(unit: float) -> NDArray[np.floating]:
        m, given = model(), [backward(np.full(3, scale)) for _ in range(2)]
        m.means[:], m.distances[:] = 0.0, 3.0
        for each in given:
            each.parameters[:, MEAN:ROTATION] /= unit
        measure_curvature(Pool(1), m, given[0], extent=unit)
        rates = RATES.scaled(0.01 * unit, 1.0, unit)
        apply_gradients(Pool(1), m, given[1], 4, rates, 100, 50, damping=DAMPED)
        return m.means / unit

    assert of(1.0).any()
    np.testing.assert_allclose(of(unit), of(1.0), rtol=1e-4)


def test_it_settles_where_the_slope_is_zero_however_steep_the_parameters_are() -> None:
    """Curvatures of 1e-2 to 1e4, one parameter each."""
    m, slopes = model(1), np.geomspace(1e-2, 1e4, USED)
    wanted = np.concatenate([array.reshape(1, -1) for array in m.arrays], 1)[0] + 0.01
    for step in range(6000):
        now = np.concatenate([array.reshape(1, -1) for array in m.arrays], 1)[0]
        gradient = backward(np.zeros(1))
        gradient.parameters[0, :USED] = slopes * (now - wanted)
        if step % INTERVAL == 0:
            measured = backward(np.zeros(1))
            measured.parameters[0, :USED] = np.sqrt(slopes)
            measure_curvature(Pool(1), m, measured, extent=1.0)
        apply_gradients(Pool(1), m, gradient, 4, RATES, 100, 50, damping=DAMPED)
    now = np.concatenate([array.reshape(1, -1) for array in m.arrays], 1)[0]
    # a step below half of the last digit of a value up to 4 is lost
    np.testing.assert_allclose(now, wanted, atol=DAMPED * 2.4e-7)


VIEWS = 20


def measures_in(schedule: Schedule, first: int) -> list[bool]:
    """Whether each step from `first` on measures. All move by the curvature."""
    kinds = [schedule.gauss_newton(step, VIEWS) for step in range(first, schedule.steps)]
    assert None not in kinds
    keys = [kind.key for kind in kinds if kind is not None and kind.key is not None]
    assert len(keys) == len(set(keys))
    return [kind is not None and kind.key is not None for kind in kinds]


def test_it_moves_once_densification_has_ended() -> None:
    schedule = Schedule(steps=1000, extent=1.0, sh_degree=1, n_start=10, seed=3)
    assert {schedule.gauss_newton(step, VIEWS) for step in range(500)} == {None}
    assert measures_in(schedule, 500) == measures_in(schedule, 500)


@pytest.mark.parametrize("since", [(0, 0.0), DENSIFYING_PART, LAST_PART])
def test_it_measures_each_view_once_in_a_row_and_then_one_step_in_so_many(
    since: tuple[int, float],
) -> None:
    schedule = Schedule(1000, extent=1.0, sh_degree=1, n_start=10, seed=3, since=since)
    first = next(step for step in range(1000) if not schedule.densifying(step))
    found = measures_in(schedule, first)
    assert all(found[:VIEWS])
    assert abs(sum(found[VIEWS:]) - (1000 - first - VIEWS) / INTERVAL) <= 1


def test_a_plan_that_is_changed_later_measures_no_view_anew() -> None:
    schedule = Schedule(steps=1000, extent=1.0, sh_degree=1, n_start=10, seed=3)
    for steps in (900, 1500):
        found = measures_in(schedule.replanned(700, steps), 700)
        assert abs(sum(found) - (steps - 700) / INTERVAL) <= 1


def test_a_run_of_few_steps_measures_in_each() -> None:
    for steps in (2, 3, 10):
        schedule = Schedule(steps, extent=1.0, sh_degree=0, n_start=10, seed=0)
        assert all(measures_in(schedule, steps - steps // 2))


@pytest.mark.parametrize("backend", ["cpu", "gpu", "webgpu"])
def test_adams_second_moment_is_forgotten_when_densification_ends(
    backend: str, tmp_path: Path
) -> None:
    if backend == "gpu":
        pytest.importorskip("triton")
    if backend == "webgpu" and (why := device.missing()):
        pytest.skip(why)
    start = cloud(20, 24, 16, degree=0, seed=2)
    picture = np.random.default_rng(0).random((16, 24, 3)).astype(np.float32)
    schedule = Schedule(steps=40, extent=1.0, sh_degree=0, n_start=20, seed=0)
    trainer = trainer_of(
        *(schedule, [view_of("one", picture, camera(24, 16))], [], DrawSettings(near=0.1)),
        *(100, tmp_path, Report()),
        backend=backend,
    )
    trainer.begin(start)
    end = round(40 * DENSIFICATION_END)
    for step in range(end):
        trainer.step(step)
        if step + 1 < end:
            Curvature().after_step(trainer, step + 1)
    before = trainer.model.on_host()
    assert before.moment2.any()
    Curvature().after_step(trainer, end)
    after = trainer.model.on_host()
    assert not after.moment2.any()
    for name in ("means", "moment1", "steps", "gradient_count"):
        np.testing.assert_array_equal(getattr(after, name), getattr(before, name))
    trainer.step(end)
    Curvature().after_step(trainer, end + 1)
    assert trainer.model.on_host().moment2.any()
