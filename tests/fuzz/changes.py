"""Damage to a file's bytes, drawn by Hypothesis: blind for bytes, by word for text."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable

from hypothesis import strategies as st

Change = Callable[[bytes], bytes]

HEAD_BYTES = 1500  # counts, versions, types and names lie there in every format
_TOKENS = re.compile(rb'-?\d[\d.]*(?:[eE][+-]?\d+)?|"[^"]*"|[A-Za-z_][\w:]*')

_INTEGERS = (0, 1, -1, 255, 256, 2**31 - 1, -(2**31), 2**32 - 1, 2**63 - 1, -(2**63))
_FLOATS = (float("nan"), float("inf"), -float("inf"), 1e38, -1e38, 1e-45, 1e308)
HOSTILE_BYTES = (
    *(struct.pack("<i", max(-(2**31), min(value, 2**31 - 1))) for value in _INTEGERS),
    *(struct.pack("<q", value) for value in _INTEGERS),
    *(struct.pack("<f", min(max(value, -3e38), 3e38)) for value in _FLOATS),
    *(struct.pack("<d", value) for value in _FLOATS),
    b"\x00" * 16,
    b"\xff" * 16,
)
HOSTILE_WORDS = (
    *(str(value).encode() for value in _INTEGERS),
    *(b"1e999 -1e999 NaN nan Infinity 0.5 1e-400 99999999999999999999".split()),
    *(b'null true [] {} [[]] "" "x" list'.split()),
    b'"../../../../etc/passwd"',
    b'"/dev/zero"',
    b'"file:///etc/passwd"',
    b'"data:application/octet-stream;base64,AAAA"',
    b'"\\u0000"',
    b"[" * 3000,
    b'{"a":' * 3000,
)


def _where(draw: st.DrawFn, size: int) -> int:
    if draw(st.booleans()):
        return draw(st.integers(0, min(size, HEAD_BYTES)))
    return draw(st.integers(0, size))


@st.composite
def _overwritten(draw: st.DrawFn, content: bytes) -> bytes:
    at = _where(draw, len(content))
    new = draw(st.one_of(st.binary(min_size=1, max_size=8), st.sampled_from(HOSTILE_BYTES)))
    removed = draw(st.sampled_from((len(new), len(new), 0, 3)))  # mostly in place
    return content[:at] + new + content[at + removed :]


@st.composite
def _moved(draw: st.DrawFn, content: bytes) -> bytes:
    """A piece left out, or put in again elsewhere."""
    start, to = _where(draw, len(content)), _where(draw, len(content))
    piece = content[start : start + draw(st.integers(1, 200))]
    if draw(st.booleans()):
        return content[:to] + piece + content[to:]
    return content[:start] + content[start + len(piece) :]


@st.composite
def _cut(draw: st.DrawFn, content: bytes) -> bytes:
    return content[: _where(draw, len(content))]


@st.composite
def _reworded(draw: st.DrawFn, content: bytes) -> bytes:
    """One number, string or name replaced: by something hostile, or by another of the same file."""
    words = list(_TOKENS.finditer(content, 0, 20_000))
    if not words:
        return content
    word = words[draw(st.integers(0, len(words) - 1))]
    other = words[draw(st.integers(0, len(words) - 1))][0]
    new = draw(st.one_of(st.sampled_from(HOSTILE_WORDS), st.just(other)))
    return content[: word.start()] + new + content[word.end() :]


@st.composite
def damaged(draw: st.DrawFn, content: bytes, *, text: bool) -> bytes:
    """`content` with one to three changes. text: mostly by word, so that more of the file still
    means something."""
    kinds = [_overwritten] * 4 + [_moved, _cut]
    if text:
        kinds += [_reworded] * 12
    for _ in range(draw(st.integers(1, 3))):
        content = draw(draw(st.sampled_from(kinds))(content))
    return content
