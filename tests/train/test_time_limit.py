"""How many steps a run makes: its settings, its training views and a time limit decide."""

import numpy as np
import pytest

from stages.base.stage import Report
from stages.scene import DrawSettings
from stages.train.build import LEAST_STEPS, make_trainer, most_steps_for
from stages.train.conversion import model_of
from stages.train.density import AdaptiveDensity, gradient_threshold
from stages.train.hooks import Densification, step_hooks
from stages.train.optimiser import LearningRates
from stages.train.schedule import (
    PUBLISHED_STEPS,
    RATE_DECAY_END,
    RATES_POWER,
    SCALES,
    Schedule,
)
from stages.train.settings import PRESETS, TrainSettings
from stages.train.time_limit import TimeLimit
from tests.scenes import camera, cloud
from tests.small_scene import small_scene
from tests.train.pictures import trainer_of, view_of

PARTS = ((0, 600), (600, 1500), (1500, 3000))  # steps before, while and after the model grows


def schedule(steps=3000):
    return Schedule(steps=steps, extent=1.0, sh_degree=2, n_start=1000, seed=0)


def simulated(seconds, cost, steps=100_000, most_steps=0, steps_after=0):
    """(seconds that a run takes, its schedule at the end), if a step at a share costs `cost`."""
    plan, pace = schedule(steps), TimeLimit(seconds, most_steps, 1.0, steps_after)
    spent, step = 0.0, 0
    while step < plan.steps:
        spent += cost(plan.share(step))
        step += 1
        if step < plan.steps and (new := pace.steps(step, spent)):
            plan = plan.replanned(step, new)
    return spent + 1.0, plan


@pytest.mark.parametrize("seconds", [20.0, 60.0, 900.0])
@pytest.mark.parametrize(
    "cost",
    [
        lambda share: 0.02,
        lambda share: 0.02 if share < 0.2 else 0.09,  # pictures at half size come first
        lambda share: 0.02 + 0.2 * min(share, 0.5),  # splats become more
        lambda share: 0.05 * (1 + 0.8 * np.sin(40 * share)),  # another program on the machine
    ],
)
def test_a_run_with_a_time_limit_ends_within_a_tenth_of_it_and_goes_through_all_of_its_course(
    seconds, cost
):
    took, plan = simulated(seconds, cost)
    assert took == pytest.approx(seconds, rel=0.1)
    assert plan.share(plan.steps) == pytest.approx(1.0)
    raised = LearningRates().sh_dc * plan.raised(RATES_POWER)
    assert plan.rates(plan.steps).sh_dc == pytest.approx(RATE_DECAY_END * raised)


def test_a_time_limit_plans_no_more_steps_than_the_training_views_allow():
    took, plan = simulated(60.0, lambda share: 0.02, steps=500, most_steps=800)
    assert plan.steps == 800
    assert took < 20
    assert plan.share(800) == pytest.approx(1.0)


def steps_of(tmp_path, views, **settings):
    """The number of steps that a run on so many photographs plans."""
    tmp_path.mkdir()
    scene = small_scene(tmp_path, views=views)
    made = make_trainer(
        *(scene.reconstruction, scene.splats, TrainSettings(max_splats=100, **settings)),
        *(tmp_path, Report()),
    )
    return made.schedule.steps, made.task.most_steps


def test_each_training_view_takes_its_steps(tmp_path):
    """One of five photographs is held out."""
    assert steps_of(tmp_path / "a", 5, steps_per_view=1_000) == (4_000,) * 2
    assert steps_of(tmp_path / "b", 5, steps_per_view=10_000) == (PUBLISHED_STEPS,) * 2
    assert steps_of(tmp_path / "c", 5, steps_per_view=100) == (LEAST_STEPS,) * 2


@pytest.mark.parametrize(
    ("views", "steps"), [(3, 2_000), (16, 2_400), (21, 3_150), (30, 6_300), (66, 30_000)]
)
def test_best_makes_more_steps_for_each_view_the_more_views_there_are(views, steps):
    """And never fewer than `standard`."""
    presets = [most_steps_for(PRESETS[name].steps_per_view, views) for name in ("standard", "best")]
    assert presets[1] == steps >= presets[0]


def test_more_photographs_never_take_fewer_steps(tmp_path):
    numbers = (3, 4, 8, 9)
    made = [steps_of(tmp_path / str(n), n, steps_per_view=500)[0] for n in numbers]
    assert made == sorted(made)


def test_a_given_number_of_steps_is_made(tmp_path):
    assert steps_of(tmp_path / "a", 5, steps=5000, steps_per_view=1_000) == (5000, 5000)
    assert steps_of(tmp_path / "b", 5, steps=300, steps_per_view=1_000) == (300, 4_000)


def test_however_long_the_limit_a_run_makes_the_steps_that_its_photographs_are_worth(tmp_path):
    """A run that would end before its first plan is made is no shorter than one with a plan."""
    for steps in (10, 300):
        limited = {"steps": steps, "seconds": 36_000.0, "steps_per_view": 1_000}
        assert steps_of(tmp_path / f"{steps}", 5, **limited) == (4_000, 4_000)
    assert steps_of(tmp_path / "more", 5, steps=9_000, seconds=60.0)[0] == 9_000


def test_steps_after_the_last_one_have_their_time_in_the_limit():
    _, without = simulated(60.0, lambda share: 0.02)
    _, plan = simulated(60.0, lambda share: 0.02, steps_after=720)
    assert without.steps - plan.steps == pytest.approx(720, abs=60)


def test_steps_that_take_a_second_each_still_end_in_time():
    took, _ = simulated(60.0, lambda share: 1.0)
    assert 30 < took < 66


def test_a_plan_that_is_never_changed_is_the_share_of_steps():
    plan = schedule(400)
    assert [plan.share(step) for step in (0, 100, 400)] == [0.0, 0.25, 1.0]
    assert sum(plan.passes(step, 10) for step in range(1, 401)) == 10


def test_a_changed_plan_goes_on_from_where_the_run_is_and_ends_at_its_end():
    plan = schedule(1000).replanned(300, 600)
    assert plan.share(300) == pytest.approx(0.3)
    assert plan.share(450) == pytest.approx(0.65)
    assert plan.share(600) == 1.0
    again = schedule(1000).as_planned(plan.steps, *plan.since)
    assert again == plan


def test_densification_takes_the_threshold_of_the_plan(tmp_path, monkeypatch):
    """With a time limit the number of steps is only known once some have been timed."""
    thresholds = []

    def grow(self, model, budget, threshold):
        thresholds.append(threshold)
        return model

    monkeypatch.setattr(AdaptiveDensity, "grow", grow)
    start = cloud(50, 40, 30, degree=0)
    view = view_of("a", np.zeros((30, 40, 3)), camera(40, 30))
    made = trainer_of(
        *(Schedule(7000, 10.0, 0, 50, 0), [view] * 3, [], DrawSettings(near=0.1), 50, tmp_path),
        Report(),
        backend="cpu",
    )
    made.stepper.load(model_of(start))
    hooks = step_hooks(made, start)
    densification = next(hook for hook in hooks if isinstance(hook, Densification))
    for steps in (7000, 28_000, 2000):
        made.schedule = made.schedule.replanned(50, steps)
        densify_at = next(s for s in range(51, steps) if made.schedule.densifies_after(s - 1))
        densification.after_step(made, densify_at)
    assert thresholds == [gradient_threshold(steps) for steps in (7000, 28_000, 2000)]


def test_pictures_are_as_planned_to_the_very_end_of_any_plan():
    plan = schedule(1000)
    for step in range(10, 990, 7):
        plan = plan.replanned(step, 1000)
    assert [plan.level(s) for s in range(980, 1000)] == [
        schedule().level(s) for s in range(2980, 3000)
    ]


def test_after_densification_some_pictures_are_smaller_and_count_by_the_area_of_their_pixels():
    plan = schedule()
    scales = {part: [SCALES[plan.level(s)] for s in range(*part)] for part in PARTS}
    assert set(scales[0, 600]) == {0.5}
    assert set(scales[600, 1500]) == {1.0}
    late = scales[1500, 3000]
    assert [late.count(scale) for scale in SCALES] == [75, 75, 75, 1275]
    assert {plan.weight(s) for s in range(1500)} == {1.0}
    assert [plan.weight(s) for s in range(1500, 3000)] == [scale**-2 for scale in late]
