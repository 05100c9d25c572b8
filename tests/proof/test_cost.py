"""How many numbers a splat is, and how many training holds of it."""

import numpy as np
import pytest

from stages.raster.definition import splat_arrays, used_columns
from stages.scene import parameters_per_splat
from stages.train.optimiser import new_model
from tests.scenes import cloud


@pytest.mark.parametrize(("degree", "floats"), list(enumerate((14, 23, 38, 59))))
def test_our_splats_hold_as_many_numbers(degree, floats):
    scene = cloud(7, degree=3).with_sh_degree(degree)
    assert parameters_per_splat(np.array(degree)) == floats
    assert sum(a.size for a in scene.arrays) == 7 * floats


def test_the_model_in_training_holds_each_number_and_its_two_moments():
    """Its gradient, the fourth, is the step's; rows of both are padded."""

    def used(rows):
        return rows[:, : used_columns(16)].nbytes

    model = new_model(*splat_arrays(cloud(7, degree=3)))
    held = sum(a.nbytes for a in model.arrays)
    assert held == 7 * 59 * 4
    assert held + used(model.moment1) + used(model.moment2) == 3 * held
