"""Text for readers: numbers with their nouns, printable names, reasons that a library gives."""

from __future__ import annotations

import re
import shlex
from collections.abc import Sequence
from pathlib import Path

from rich.filesize import decimal

# C0 without the line feed, DEL, C1, and the marks that change the direction of writing.
_CONTROLS = re.compile("[\x00-\x09\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069]")
_NO_UTF8 = re.compile("[\udc80-\udcff]")  # bytes of file names, as Python writes them (PEP 383)
_CPP_NAME = re.compile(r"\b[A-Za-z_]\w*(?:::~?[A-Za-z_]\w*)+(?:<[^>]*>)?(?:\([^)]*\))?:?")
_ADVICE = re.compile(r"[;,] (?:use|see|set|try|consider|pass)\b.*", re.IGNORECASE)


def counted(count: int, noun: str, plural: str = "") -> str:
    """ "1 photograph", "3 photographs", "1,200 splats". plural: where adding an s is wrong."""
    return f"{count:,} {noun if count == 1 else plural or noun + 's'}"


def size(count: float) -> str:
    """Bytes as people read them: "1.3 MB"."""
    return decimal(int(count))


def listed(names: Sequence[str], most: int = 8) -> str:
    """Names for a message: the first `most` of them, and how many there are besides."""
    rest = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(name[:80] for name in names[:most]) + rest


def quoted(path: Path | str) -> str:
    """A path, or a URL, as it stands in a command for a shell."""
    return shlex.quote(str(path))


def printable(text: str) -> str:
    """`text` with escapes, such as \\x1b, for control characters except the line feed, and for
    what is no UTF-8, such as bytes of file names: a terminal would act on the first and Python
    cannot print the others."""
    text = _NO_UTF8.sub(lambda found: f"\\x{ord(found[0]) - 0xDC00:02x}", text)
    text = text.encode("utf-8", "backslashreplace").decode()
    return _CONTROLS.sub(lambda found: ascii(found[0])[1:-1], text)


def printable_name(name: str) -> str:
    """`printable`, in one line."""
    return printable(name).replace("\n", "\\n")


def reason_of(error: BaseException) -> str:
    """What a library said, in a line of at most 160 characters, without C++ names and without
    advice to programmers; the type of the error where nothing is left."""
    line = " ".join(_CPP_NAME.sub("", str(error)).strip().partition("\n")[0].split())
    return _ADVICE.sub("", line).strip(" :;,.")[:160] or type(error).__name__
