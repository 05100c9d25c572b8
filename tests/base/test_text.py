"""Words that depend on a number, names that a terminal can show, what is left of a library's."""

from __future__ import annotations

import pytest

from stages.base.text import counted, printable, printable_name, reason_of


@pytest.mark.parametrize(
    ("count", "text"), [(0, "0 photographs"), (1, "1 photograph"), (1200, "1,200 photographs")]
)
def test_noun_agrees_with_its_number(count: int, text: str) -> None:
    assert counted(count, "photograph") == text


def test_plural_that_takes_more_than_an_s() -> None:
    assert counted(1, "box", "boxes") == "1 box"
    assert counted(2, "box", "boxes") == "2 boxes"


@pytest.mark.parametrize(
    ("said", "left"),
    [
        ("colmap::Reconstruction::Read(const std::string&): no such model", "no such model"),
        ("std::bad_alloc", "RuntimeError"),
        (
            "Exceeds the limit (4300 digits) for integer string conversion; "
            "use sys.set_int_max_str_digits() to increase the limit",
            "Exceeds the limit (4300 digits) for integer string conversion",
        ),
        ("the first line\nTraceback", "the first line"),
        ("", "RuntimeError"),
        ("x" * 1000, "x" * 160),
    ],
)
def test_what_a_library_said_keeps_neither_its_names_nor_its_advice(said: str, left: str) -> None:
    assert reason_of(RuntimeError(said)) == left


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("été 雪.jpg", "été 雪.jpg"),
        ("a\x1b[31mb", "a\\x1b[31mb"),
        ("bell\x07, C1 \x9b2J", "bell\\x07, C1 \\x9b2J"),
        ("gnp.\u202ejpg", "gnp.\\u202ejpg"),
        ("bad\udcff.jpg", "bad\\xff.jpg"),
        ("two\nlines", "two\nlines"),
        ("half \ud800 of a pair, \udcff", "half \\ud800 of a pair, \\xff"),
    ],
)
def test_what_a_terminal_would_act_on_is_escaped(text: str, shown: str) -> None:
    assert printable(text) == shown
    shown.encode()


def test_printable_name_is_one_line() -> None:
    assert printable_name("two\nlines") == r"two\nlines"
