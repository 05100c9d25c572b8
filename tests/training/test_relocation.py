"""Growth by moving what does not show."""

import numpy as np
import pytest

from stages.scene import logit
from stages.train import TrainSettings
from stages.training.optimiser import Model, new_model
from stages.training.relocation import MOST_COPIES, Relocation, shared
from stages.training.strategies import STRATEGIES

EXTENT = 10.0


def model(opacities, scale=0.01) -> Model:
    """Splats a unit from each other along x."""
    n = len(opacities)
    means = np.zeros((n, 3), np.float32)
    means[:, 0] = np.arange(n)
    return new_model(
        means,
        np.tile(np.array([1, 0, 0, 0], np.float32), (n, 1)),
        np.full((n, 3), np.log(scale), np.float32),
        logit(np.asarray(opacities, np.float64)).astype(np.float32),
        np.zeros((n, 4, 3), np.float32),
    )


def grow(m, budget):
    return Relocation(EXTENT).grow(m, budget, np.random.default_rng(0))


@pytest.mark.parametrize("opacity", [0.01, 0.5, 0.99])
@pytest.mark.parametrize("copies", [1, 2, 7, MOST_COPIES])
def test_copies_in_one_place_stop_as_much_light_as_the_one_did(opacity, copies):
    each, narrower = shared(np.array([opacity]), np.array([copies]))
    x = np.linspace(-8, 8, 4001)
    one = opacity * np.exp(-(x**2) / 2)
    all_of_them = 1 - (1 - each * np.exp(-((x / narrower) ** 2) / 2)) ** copies
    assert all_of_them.sum() == pytest.approx(one.sum(), rel=1e-6)
    assert all_of_them.max() == pytest.approx(opacity, rel=1e-6)


def test_what_does_not_show_moves_to_where_others_do():
    grown = grow(model([0.001, 0.5, 0.002, 0.5, 0.9]), 5)
    assert len(grown) == 5
    assert set(np.rint(grown.means[:, 0])) == {1, 3, 4}
    assert not grown.moment1.any()


def test_growth_keeps_to_the_budget_and_takes_from_nothing_that_shows():
    m = model([0.5] * 10)
    assert len(grow(m, 30)) == 30
    assert len(grow(m, 4)) == 10


def test_what_shows_stands_still_and_what_hardly_shows_does_not():
    m = model([0.5, 0.0051])
    grown = grow(m, 2)
    assert grown.means[0, 0] == m.means[0, 0]
    assert grown.means[1, 0] != m.means[1, 0]


def test_a_scene_where_nothing_shows_is_left_to_training():
    assert len(grow(model([0.001] * 3), 10)) == 3
    assert len(grow(model([]), 10)) == 0


def test_broken_splats_and_giants_go():
    m = model([0.5] * 4)
    m.means[0, 1] = np.nan
    m.log_scales[1] = np.log(0.11 * EXTENT)
    assert len(Relocation(EXTENT).prune(m, settled=True)) == 2
    assert len(Relocation(EXTENT).prune(m, settled=False)) == 3


def test_every_strategy_can_be_chosen_by_name():
    choices = TrainSettings.__dataclass_fields__["growth"].metadata["choices"]
    assert choices == tuple(STRATEGIES)
