"""Text of messages: numbers with their nouns, and what a library said."""

from __future__ import annotations

import re

_CPP_NAME = re.compile(r"\b[A-Za-z_]\w*(?:::~?[A-Za-z_]\w*)+(?:<[^>]*>)?(?:\([^)]*\))?:?")
_ADVICE = re.compile(r"[;,] (?:use|see|set|try|consider|pass)\b.*", re.IGNORECASE)


def counted(count: int, noun: str, plural: str = "") -> str:
    """ "1 photograph", "3 photographs", "1,200 splats". plural: where adding an s is wrong."""
    return f"{count:,} {noun if count == 1 else plural or noun + 's'}"


def reason_of(error: BaseException) -> str:
    """What a library said, in a line of at most 160 characters, without C++ names and without
    advice to programmers; the type of the error where nothing is left."""
    line = " ".join(_CPP_NAME.sub("", str(error)).strip().partition("\n")[0].split())
    return _ADVICE.sub("", line).strip(" :;,.")[:160] or type(error).__name__
