"""The stages as one list, and options that several of them have."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest

from splatcli import run_settings
from stages.base.settings import settings_of
from stages.run.stages import SHARED_OPTIONS, STAGE_NAMES, STAGE_OF, STAGES, options_of
from stages.train.settings import PRESETS


def test_stages_read_earlier_ones_only() -> None:
    for number, stage in enumerate(STAGES):
        assert set(stage.reads) <= set(STAGE_NAMES[:number])


def test_every_option_of_several_stages_says_who_gets_it() -> None:
    counts = Counter(
        setting.name for stage in STAGES for setting in settings_of(stage.settings_type)
    )
    assert {name for name, count in counts.items() if count > 1} == SHARED_OPTIONS.keys()
    for name, stages in SHARED_OPTIONS.items():
        for stage in stages:
            assert name in {s.name for s in settings_of(STAGE_OF[stage].settings_type)}


def test_the_cap_of_a_run_is_no_target_of_pruning() -> None:
    """As a target it would silence the warning that pruning lost too much."""
    settings = run_settings.of_new_run({"max_splats": 5000})
    assert settings["train"].max_splats == 5000
    assert settings["prune"].max_splats == 0
    alone = run_settings.combined({"prune": settings["prune"]}, {"max_splats": 400}, None)
    assert alone["prune"].max_splats == 400


@pytest.mark.parametrize("drawing", ["plain", "antialiased"])
def test_what_files_are_drawn_as_is_decided_once_for_a_run(drawing: str) -> None:
    settings = run_settings.of_new_run({"drawing": drawing})
    assert {settings[stage].drawing for stage in ("train", "quantise", "export")} == {drawing}


def test_an_option_of_one_stage_goes_to_that_stage() -> None:
    given = {"steps": 7, "seed": 3, "max_splats": 9}
    assert options_of("train", given) == given
    assert options_of("sfm", given) == {"steps": 7, "seed": 3}  # `steps` is no field of it


@pytest.mark.parametrize("preset", PRESETS)
def test_a_number_of_splats_that_is_given_holds_for_any_number_of_photographs(preset: str) -> None:
    preset_alone = run_settings.of_new_run({"preset": preset})["train"]
    assert preset_alone.splats_per_view == PRESETS[preset].splats_per_view
    given = run_settings.of_new_run({"preset": preset, "max_splats": 400_000})["train"]
    assert (given.max_splats, given.splats_per_view) == (400_000, 0)
    both = {"preset": preset, "max_splats": 400_000, "splats_per_view": 500}
    assert run_settings.of_new_run(both)["train"].splats_per_view == 500


@pytest.mark.parametrize("preset", PRESETS)
def test_a_preset_changes_what_presets_decide_and_nothing_else(preset: str) -> None:
    given = {"drawing": "plain", "background": "any", "seed": 7, "backend": "cpu", "smooth": True}
    begun = run_settings.of_new_run({**given, "seconds": 60.0})
    settings = run_settings.combined(begun, {}, preset)
    for name, value in given.items():
        holders = [stage for stage in settings.values() if hasattr(stage, name)]
        assert {getattr(stage, name) for stage in holders} == {value}
    train, own = settings["train"], PRESETS[preset]
    amount = ("steps", "steps_per_view", "train_side", "sh_degree", "max_splats", "seconds")
    assert [getattr(train, name) for name in amount] == [getattr(own, name) for name in amount]


def test_a_preset_leaves_the_steps_of_given_splats() -> None:
    begun = run_settings.of_new_run({"splats": Path("other.ply"), "steps": 3000})
    assert run_settings.combined(begun, {}, "best")["train"].steps == 3000
