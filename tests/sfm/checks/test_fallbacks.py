"""Fallbacks: which configuration follows which failure, and which attempt is used."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from stages.base.errors import SplatError
from stages.base.stage import Report
from stages.scene import Capture
from stages.sfm.checks.acceptance import accepted_model, report_warnings
from stages.sfm.checks.fallbacks import (
    ANOTHER_START,
    CONFIGURATIONS,
    LEARNED,
    Attempt,
    Configuration,
    best_attempt,
    try_configurations,
)
from stages.sfm.checks.gates import ModelStatistics, failure
from stages.sfm.worker.sparse_model import MappingResult
from tests.sfm.synthetic import orbit_model


def failing(*codes: str) -> tuple[SplatError, ...]:
    return tuple(failure(code, "G.", "W.", "H.") for code in codes)


class Script:
    """The failures of each configuration by name; others fail with `otherwise`."""

    def __init__(self, otherwise: str, **results: tuple[str, ...]) -> None:
        self.otherwise = otherwise
        self.results = {name.replace("_", " "): codes for name, codes in results.items()}
        self.tried: list[str] = []

    def __call__(self, configuration: Configuration) -> Attempt:
        self.tried.append(configuration.name)
        codes = self.results.get(configuration.name, (self.otherwise,))
        return Attempt(configuration, failing(*codes), ModelStatistics(photographs=10))


def run(script: Script) -> Attempt:
    return best_attempt(try_configurations(script, out_of_time=lambda: False))


def test_a_good_capture_is_reconstructed_once() -> None:
    script = Script("sfm-no-model", standard=())
    assert run(script).passed
    assert script.tried == ["standard"]


def test_no_fallback_is_tried_for_a_lack_of_parallax() -> None:
    script = Script("sfm-no-parallax")
    assert not run(script).passed
    assert script.tried == ["standard"]


def test_unregistered_photographs_try_looser_registration_and_then_more_features() -> None:
    script = Script("sfm-too-few-registered")
    run(script)
    assert script.tried == ["standard", "looser registration", "more features"]


def test_a_crash_of_the_mapper_tries_once_more() -> None:
    script = Script("sfm-crashed")
    run(script)
    assert script.tried == ["standard", "looser registration"]


def test_few_features_are_followed_by_more_features_alone() -> None:
    script = Script("sfm-too-few-features")
    run(script)
    assert script.tried == ["standard", "more features"]


def test_when_time_is_up_the_first_attempt_has_still_been_made() -> None:
    script = Script("sfm-too-few-registered")
    try_configurations(script, out_of_time=lambda: True)
    assert script.tried == ["standard"]


def test_every_fallback_lists_what_it_may_fix() -> None:
    assert not CONFIGURATIONS[0].fixes
    assert all(configuration.fixes for configuration in CONFIGURATIONS[1:])
    assert len({configuration.name for configuration in CONFIGURATIONS}) == len(CONFIGURATIONS)


def passed(registered: int, learned: bool = False) -> Attempt:
    configuration = LEARNED if learned else CONFIGURATIONS[0]
    return Attempt(configuration, (), ModelStatistics(photographs=10, registered=registered))


def tried(first: Attempt, features: str) -> list[str]:
    """The configurations that follow `first` if learned features pass with all photographs."""

    def run(configuration: Configuration) -> Attempt:
        names.append(configuration.name)
        return passed(10, learned=True) if configuration.learned else first

    names: list[str] = []
    try_configurations(run, out_of_time=lambda: False, features=features)
    return names


def test_learned_features_follow_sift_only_where_photographs_are_left_out() -> None:
    assert tried(passed(10), "auto") == ["standard"]
    assert tried(passed(9), "auto") == ["standard", "learned features"]
    assert tried(passed(9), "sift") == ["standard"]
    assert tried(passed(9), "learned") == ["learned features"]


def checked(inconsistent: int, registered: int = 10, again: bool = False) -> Attempt:
    """An attempt that passed, and so many of whose 100 pairs contradict it."""
    configuration = ANOTHER_START if again else CONFIGURATIONS[0]
    statistics = ModelStatistics(
        photographs=10,
        registered=registered,
        pairs_checked=100,
        pairs_inconsistent=inconsistent,
        inconsistent_pair=("a.jpg", "b.jpg"),
    )
    return Attempt(configuration, (), statistics)


def test_a_model_that_pairs_contradict_is_mapped_again_from_another_initial_pair() -> None:
    assert tried(checked(7), "sift") == ["standard", "another initial pair"]
    assert tried(checked(7), "auto") == ["standard", "another initial pair"]
    assert tried(checked(2), "sift") == ["standard"]
    turned = replace(checked(7).statistics, pairs_turned=5)  # no poses would change that
    assert tried(Attempt(CONFIGURATIONS[0], (), turned), "sift") == ["standard"]


def test_the_model_from_another_initial_pair_is_used_if_half_as_many_pairs_contradict_it() -> None:
    standard = checked(8)
    for inconsistent, used in ((0, True), (4, True), (5, False), (9, False)):
        again = checked(inconsistent, registered=9, again=True)
        assert best_attempt([standard, again]) is (again if used else standard)
    failed = Attempt(ANOTHER_START, failing("sfm-too-few-registered"), checked(0).statistics)
    assert best_attempt([standard, failed]) is standard


def test_learned_features_do_not_help_against_a_lack_of_parallax() -> None:
    failed = Attempt(CONFIGURATIONS[0], failing("sfm-no-parallax"), ModelStatistics(photographs=10))
    assert tried(failed, "auto") == ["standard"]


def test_the_attempt_with_most_photographs_is_used_and_sift_where_they_are_as_many() -> None:
    sift, learned = passed(9), passed(10, learned=True)
    assert best_attempt([sift, learned]) is learned
    assert best_attempt([sift, passed(9, learned=True)]) is sift


def test_photographs_that_show_nothing_are_reported_as_that() -> None:
    """Learned features find some matches on a blank wall, and then fail for another reason."""
    blank = Attempt(
        CONFIGURATIONS[0], failing("sfm-too-few-features"), ModelStatistics(photographs=10)
    )
    some = ModelStatistics(photographs=10, registered=3, models=(3,), points=80)
    learned = Attempt(LEARNED, failing("sfm-too-few-registered"), some)
    with pytest.raises(SplatError) as caught:
        accepted_model([blank, learned], Capture(Path("."), ()), allow_partial=False)
    assert caught.value.code == "sfm-too-few-features"


def test_sift_follows_where_learned_features_fail_first() -> None:
    script = Script("sfm-high-error", standard=())
    attempts = try_configurations(script, out_of_time=lambda: False, features="learned")
    assert script.tried == ["learned features", "standard"]
    assert best_attempt(attempts).configuration.name == "standard"


@pytest.mark.parametrize("other", ["02.jpg", "lost.jpg"])
def test_a_model_that_the_largest_contains_needs_no_warning(other: str) -> None:
    model = orbit_model(views=6, points=40)
    result = MappingResult(model, (model.names, ("01.jpg", other)), timed_out=False)
    attempt = Attempt(CONFIGURATIONS[0], (), ModelStatistics(photographs=6), result)
    report = Report()
    report_warnings([attempt], model, Capture(Path(), ()), report)
    assert ("sfm-several-models" in dict(report.warnings)) == (other == "lost.jpg")


def test_the_warning_of_a_model_that_is_used_does_not_advise_to_allow_it() -> None:
    report = Report()
    model = orbit_model(views=6, points=40)
    report_warnings([checked(16)], model, Capture(Path(), ()), report)
    warning = dict(report.warnings)["sfm-contradictions"]
    assert "16 of 100 pairs" in warning
    assert "--allow-partial" not in warning
