"""Options made from settings."""

from __future__ import annotations

from dataclasses import dataclass

import pytest
import typer
from typer.testing import CliRunner

from splatcli import console, options
from stages.base.errors import SplatError
from stages.base.settings import Setting, setting


@dataclass(frozen=True)
class Settings:
    long_side: int = setting(1600, "Long side (px).", min=0)
    rate: float | None = setting(None, "Rate (1/s).", max=2)
    kind: str = setting("a", "Kind.", choices=("a", "b"))
    names: tuple[str, ...] = setting((), "A name.")
    loud: bool = setting(False, "Shout.")


def parse(*words: str) -> dict:
    app = typer.Typer()
    seen = {}

    def command(**given) -> None:
        seen.update(options.given_only(given))

    app.command()(options.with_parameters(command, options.parameters(Settings)))
    CliRunner().invoke(app, list(words), catch_exceptions=False)
    return seen


def test_defaults_are_shown_as_they_are_typed() -> None:
    values = (0.0, 0.25, False, 1600)
    shown = [options.shown_default(Setting("x", "--x", type(v), default=v)) for v in values]
    assert shown == ["0", "0.25", "no", "1600"]


def test_only_what_was_typed_is_given() -> None:
    assert parse() == {}
    assert parse("--long-side", "0") == {"long_side": 0}
    assert parse("--no-loud", "--kind", "b") == {"loud": False, "kind": "b"}
    assert parse("--name", "x", "--name", "y") == {"names": ("x", "y")}
    assert parse("--rate", "1.5") == {"rate": 1.5}


@pytest.mark.parametrize("words", ["--rate 3", "--long-side -1", "--long-side x", "--kind c"])
def test_value_that_a_setting_cannot_have_is_named_with_its_option(words: str) -> None:
    with pytest.raises(SplatError, match=f"{words} cannot be used") as caught:
        parse(*words.split())
    assert caught.value.family == 2


@pytest.mark.parametrize(
    ("name", "value", "text"),
    [
        ("psnr_db", 27.1234, "27.12 dB"),
        ("splats", 36700, "36,700"),
        ("reprojection_error_px", 0.34, "0.34 px"),
        ("levelled", True, "yes"),
        ("points", 1e6, "1,000,000"),
    ],
)
def test_figures_have_units_from_their_names(name: str, value: object, text: str) -> None:
    assert console.figure(name, value) == text


@pytest.mark.parametrize(
    ("seconds", "text"), [(4.21, "4.2 s"), (59.96, "60.0 s"), (185.0, "3:05"), (3723, "1:02:03")]
)
def test_durations_read_well(seconds: float, text: str) -> None:
    assert console.duration(seconds) == text


@pytest.mark.parametrize(("count", "text"), [(12, "12 bytes"), (1300, "1.3 kB"), (2.5e9, "2.5 GB")])
def test_sizes_read_well(count: float, text: str) -> None:
    assert console.size(count) == text


def test_equal_pictures_are_exact_and_no_number_of_decibels() -> None:
    assert console.fidelity(99.0) == "exact"
    assert console.fidelity(41.26) == "41.26 dB"


@pytest.mark.parametrize(
    ("cpu_s", "text"), [(12.0, "10.0 s"), (5.0, "10.0 s"), (19.0, "10.0 s (19.0 s CPU)")]
)
def test_cpu_time_is_shown_where_it_differs_by_half(cpu_s: float, text: str) -> None:
    assert console.times(10.0, cpu_s) == text
