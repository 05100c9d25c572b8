"""The ladder: which rung follows which failure, and which attempt is used in the end."""

from __future__ import annotations

from stages.structure.fallbacks import (
    CONFIGURATIONS,
    Attempt,
    Attempts,
    Configuration,
    try_configurations,
)
from stages.structure.gates import Failure, ModelStatistics


def failing(*codes: str) -> tuple[Failure, ...]:
    return tuple(Failure(code, "G.", "W.", "H.") for code in codes)


class Script:
    """Answers each rung by name; a rung that is not named fails with `otherwise`."""

    def __init__(self, otherwise: str, **answers: tuple[str, ...]) -> None:
        self.otherwise = otherwise
        self.answers = {name.replace("_", " "): codes for name, codes in answers.items()}
        self.tried: list[str] = []

    def __call__(self, rung: Configuration) -> Attempt:
        self.tried.append(rung.name)
        codes = self.answers.get(rung.name, (self.otherwise,))
        return Attempt(rung, failing(*codes), ModelStatistics(photographs=10, mapper=rung.mapper))


def run(script: Script, exhaustive: bool = True) -> Attempts:
    return try_configurations(script, already_exhaustive=exhaustive, out_of_time=lambda: False)


def test_a_good_capture_is_reconstructed_once() -> None:
    script = Script("sfm-no-model", standard=())
    assert run(script).best.passed
    assert script.tried == ["standard"]


def test_no_rung_is_climbed_for_a_lack_of_parallax() -> None:
    script = Script("sfm-no-parallax")
    assert not run(script).best.passed
    assert script.tried == ["standard"]


def test_unplaced_photographs_try_looser_registration_first_and_the_global_mapper_last() -> None:
    script = Script("sfm-too-few-registered")
    run(script)
    assert script.tried == [
        "standard",
        "looser registration",
        "more features",
        "another first pair",
        "global mapper",
    ]


def test_sequential_matching_is_followed_by_every_pair() -> None:
    script = Script("sfm-too-few-registered", every_pair_matched=())
    assert run(script, exhaustive=False).best.rung.name == "every pair matched"
    assert script.tried == ["standard", "looser registration", "every pair matched"]


def test_a_wrong_camera_drops_stationary_matches() -> None:
    script = Script("sfm-implausible-distortion", without_stationary_matches=())
    assert run(script).best.rung.drop_stationary
    assert script.tried == ["standard", "without stationary matches"]


def test_few_features_ask_for_more_and_nothing_else() -> None:
    script = Script("sfm-too-few-features")
    run(script)
    assert script.tried == ["standard", "more features"]


def test_when_time_is_up_the_first_attempt_has_still_been_made() -> None:
    script = Script("sfm-too-few-registered")
    try_configurations(script, already_exhaustive=True, out_of_time=lambda: True)
    assert script.tried == ["standard"]


def test_among_failures_the_global_mapper_counts_least() -> None:
    few = Attempt(
        CONFIGURATIONS[0], failing("sfm-too-few-registered"), ModelStatistics(10, registered=5)
    )
    all_of_them = Attempt(
        CONFIGURATIONS[-1],
        failing("sfm-weak-link"),
        ModelStatistics(10, registered=10, mapper="global"),
    )
    assert Attempts([few, all_of_them]).best is few


def test_every_rung_but_the_first_says_what_it_mends() -> None:
    assert not CONFIGURATIONS[0].mends
    assert all(rung.mends for rung in CONFIGURATIONS[1:])
    assert len({rung.name for rung in CONFIGURATIONS}) == len(CONFIGURATIONS)
