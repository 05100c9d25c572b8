"""A splat in numbers: those that lessons name, and that ours are made of as many."""

import numpy as np
import pytest

from stages.proof.statistics import DEGREES, floats_of, mass_within, memory_of
from stages.raster.definition import splat_arrays, used_columns
from stages.train.optimiser import new_model
from tests.scenes import cloud


def test_the_ladder_of_numbers_by_degree():
    assert [floats_of(degree) for degree in DEGREES] == [14, 23, 38, 59]


def test_a_splat_of_degree_three_in_bytes():
    assert memory_of(3) == {"float32": 236, "half precision": 118, "in training": 944}


def test_a_million_splats_of_degree_three_in_megabytes():
    scene = memory_of(3, 1_000_000)
    assert [size / 1e6 for size in scene.values()] == [236, 118, 944]


@pytest.mark.parametrize("degree", DEGREES)
def test_our_splats_hold_as_many_numbers(degree):
    scene = cloud(7, degree=3).with_sh_degree(degree)
    assert sum(a.size for a in scene.arrays) == 7 * floats_of(degree)
    assert (
        sum(a.astype(np.float16).nbytes for a in scene.arrays)
        == memory_of(degree, 7)["half precision"]
    )


def test_the_model_in_training_holds_each_number_and_its_two_moments():
    """Its gradient, the fourth, is the step's; rows of both are padded."""

    def used(rows):
        return rows[:, : used_columns(16)].nbytes

    model = new_model(*splat_arrays(cloud(7, degree=3)))
    held = sum(a.nbytes for a in model.arrays)
    assert held == memory_of(3, 7)["float32"]
    assert held + used(model.moment1) + used(model.moment2) == 3 * held


def test_mass_within_one_two_and_three_sigma():
    assert [round(100 * mass_within(n), 1) for n in (1, 2, 3)] == [39.3, 86.5, 98.9]
