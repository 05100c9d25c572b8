"""Damage to a file's bytes, by random numbers: blind for bytes, by word for text."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable
from random import Random

Change = Callable[[Random, bytes], bytes]

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


def _where(random: Random, size: int) -> int:
    return random.randint(0, min(size, HEAD_BYTES) if random.random() < 0.5 else size)


def _overwritten(random: Random, content: bytes) -> bytes:
    at = _where(random, len(content))
    new = random.choice((random.randbytes(random.randint(1, 8)), random.choice(HOSTILE_BYTES)))
    removed = random.choice((len(new), len(new), 0, 3))  # mostly in place
    return content[:at] + new + content[at + removed :]


def _flipped(random: Random, content: bytes) -> bytes:
    """One bit."""
    at = min(_where(random, len(content)), len(content) - 1)
    if at < 0:
        return content
    return content[:at] + bytes([content[at] ^ 1 << random.randrange(8)]) + content[at + 1 :]


def _moved(random: Random, content: bytes) -> bytes:
    """A piece left out, or put in again elsewhere."""
    start, to = _where(random, len(content)), _where(random, len(content))
    piece = content[start : start + random.randint(1, 200)]
    if random.random() < 0.5:
        return content[:to] + piece + content[to:]
    return content[:start] + content[start + len(piece) :]


def _repeated(random: Random, content: bytes) -> bytes:
    """A short piece some hundred times, for counts and depths that grow."""
    start = _where(random, len(content))
    piece = content[start : start + random.randint(1, 40)]
    return content[:start] + piece * random.randint(2, 500) + content[start:]


def _cut(random: Random, content: bytes) -> bytes:
    return content[: _where(random, len(content))]


def _reworded(random: Random, content: bytes) -> bytes:
    """One number, string or name replaced: by something hostile, or by another of the same file."""
    words = list(_TOKENS.finditer(content, 0, 20_000))
    if not words:
        return content
    word = random.choice(words)
    new = random.choice((random.choice(HOSTILE_WORDS), random.choice(words)[0]))
    return content[: word.start()] + new + content[word.end() :]


_BLIND: tuple[Change, ...] = (*(_overwritten,) * 4, _flipped, _flipped, _moved, _repeated, _cut)
_BY_WORD: tuple[Change, ...] = (*_BLIND, *(_reworded,) * 16)


def damaged(random: Random, content: bytes, *, text: bool) -> bytes:
    """`content` with one to three changes. text: mostly by word, so that more of the file still
    means something."""
    for _ in range(random.choice((1, 1, 2, 3))):
        content = random.choice(_BY_WORD if text else _BLIND)(random, content)
    return content
