"""What settings may be is said once, in their metadata, and holds for everyone."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import pytest

from stages.base.errors import SplatError
from stages.base.settings import UNSET, Setting, changed, check_settings, setting, settings_of
from stages.run.stages import STAGE_NAMES, STAGE_OF

EVERY = {
    f"{name}-{setting.name}": (name, setting)
    for name in STAGE_NAMES
    for setting in settings_of(STAGE_OF[name].settings_type)
}
NUMBERS = {key: pair for key, pair in EVERY.items() if pair[1].kind in (int, float)}


@dataclass(frozen=True)
class Settings:
    side: int = setting(5, "", min=1, max=9)
    rate: float | None = setting(None, "", min=0.5)
    names: tuple[str, ...] = setting(("a",), "", choices=("a", "b"))
    title: str = setting("x", "", pattern="[a-z]+", wanted="Small letters.")
    loud: bool = False
    louder: bool = setting(False, "", needs="loud")


def with_value(name: str, setting: Setting, value: Any) -> Any:
    return replace(STAGE_OF[name].settings_type(), **{setting.name: value})


def check_value(name: str, setting: Setting, value: Any) -> None:
    """Several values together may be limited by each other, so one is checked by itself."""
    if setting.together:
        setting.check(value)
    else:
        check_settings(with_value(name, setting, value))


@pytest.mark.parametrize("key", EVERY)
def test_every_setting_has_help_and_a_default_that_it_allows(key: str) -> None:
    _, setting = EVERY[key]
    assert setting.help
    setting.check(setting.default)


@pytest.mark.parametrize("key", NUMBERS)
def test_every_number_of_every_stage_has_two_ends_and_both_may_be_used(key: str) -> None:
    name, setting = NUMBERS[key]
    assert setting.low is not None
    assert setting.high is not None
    for end in (setting.low, setting.high):
        check_value(name, setting, setting.kind(end))
    step = 1 + 1e-9 * max(abs(setting.low), abs(setting.high))  # that a float can tell
    low, high = (setting.kind(end) for end in (setting.low - step, setting.high + step))
    for beyond in (low, high, float("nan"), float("inf"), "7", True):
        with pytest.raises(SplatError, match=setting.flag) as caught:
            check_value(name, setting, beyond)
        assert caught.value.code == "option-value"
        assert f"{setting.low:,} to {setting.high:,}" in caught.value.wanted


@pytest.mark.parametrize(
    ("change", "given", "wanted"),
    [
        ({"side": 0}, "--side 0 ", "A whole number from 1 to 9."),
        ({"side": 2.5}, "--side 2.5 ", "A whole number"),
        ({"rate": 0.25}, "--rate 0.25 ", "A number of at least 0.5."),
        ({"names": ("a", "c")}, "--name c ", "One of a, b."),
        ({"names": ()}, "--name with nothing ", "One of a, b."),
        ({"title": "X"}, "--title X ", "Small letters."),
        ({"title": ""}, '--title "" ', "Small letters."),
        ({"loud": 1}, "--loud 1 ", "Yes or no."),
    ],
)
def test_error_names_the_option_what_was_given_and_what_may_be(
    change: dict[str, Any], given: str, wanted: str
) -> None:
    with pytest.raises(SplatError) as caught:
        check_settings(replace(Settings(), **change))
    assert caught.value.given.startswith(given)
    assert wanted in caught.value.wanted


def test_what_means_nothing_without_another_is_refused_alone() -> None:
    with pytest.raises(SplatError, match="--louder means nothing without --loud") as caught:
        check_settings(Settings(louder=True))
    assert caught.value.code == "option-alone"
    check_settings(Settings(loud=True, louder=True))


def test_what_is_taken_back_takes_back_what_means_nothing_without_it() -> None:
    both = Settings(loud=True, louder=True)
    assert changed(both, {"loud": UNSET}) == Settings()
    with pytest.raises(SplatError, match="--louder means nothing without --loud"):
        changed(both, {"loud": UNSET, "louder": True})


def test_what_may_be_none_or_whole_may() -> None:
    check_settings(Settings(rate=None))
    check_settings(Settings(rate=2))


@pytest.mark.parametrize("text", ["1", "9"])
def test_typed_text_becomes_a_value(text: str) -> None:
    assert settings_of(Settings)[0].parse(text) == int(text)


@pytest.mark.parametrize("text", ["", "1.5", "0", "10", "nine"])
def test_typed_text_that_is_no_value_is_refused(text: str) -> None:
    with pytest.raises(SplatError, match="--side"):
        settings_of(Settings)[0].parse(text)
