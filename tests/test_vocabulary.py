"""Words that were given up for the field's own do not come back: stages, splatcli, docs, README.

A row names the words, what to write instead, and where they mean nothing else. Parts of identifiers
count: `settled_rates` holds "settled".
"""

from __future__ import annotations

import functools
import re
from dataclasses import dataclass
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
CODE = ("stages", "splatcli")
EVERYWHERE = (*CODE, "docs", "README.md")
TRAINING = ("stages/train", "stages/prune", "stages/quantise")
SUFFIXES = (".py", ".md", ".js", ".html", ".css")


@dataclass(frozen=True)
class Word:
    """pattern: a regular expression; parts of snake_case and CamelCase names are words too.
    instead: what to write. reason: of an exception.
    """

    pattern: str
    instead: str
    where: tuple[str, ...] = EVERYWHERE
    reason: str = ""


WORDS = (
    Word("judg(e|es|ed|ing|ement)", "held-out (test) views; evaluation, evaluate"),
    Word("doubts?|doubtful", "a threshold with a name, a warning"),
    Word("way (back|there)", "backward pass, forward pass"),
    Word("backwards|forwards and", "backward pass, forward pass"),
    Word("pull(s|ed|ing)?(?! request)", "gradient"),
    Word("strides", "step size, learning rate", (*TRAINING, "docs"), "an array has one as well"),
    Word("how far", "step size, progress, distance", TRAINING),
    Word(
        '(?<!")bands?(?!")',
        "SH coefficients, SH degree",
        reason='"bands": a key of SOG',
    ),
    Word("hands", "executor; a verb: sends, gives"),
    Word(
        "(?-i:in shares)|shares? of (features|match|structure|its|it|one)",
        "chunks",
        reason="a share is a fraction, too",
    ),
    Word("placing", "registration"),
    Word("makers?", "provenance, backends"),
    Word("told(?! apart)", "reported, given, known", reason="`compare` tells two runs apart"),
    Word("asked", "requested, given; or what is done"),
    Word("settl(e|es|ed|ing)", "learning-rate decay; colour refit; robust bundle adjustment"),
    Word("prices?", "pruning strength, Lagrange multiplier, cost in bits"),
    Word("pays? (for )?(its|their|his) way", "contribution"),
    Word("rungs?|climb(s|ed|ing)?|ladder", "fallback, attempt"),
    Word("wish(es|ed)?", "request, option"),
    Word("witness(es)?", "visibility constraints"),
    Word("(?<!fine)(?<!fine[-_ ])tun(ed|er|ing)", "fine-tuned, fine-tuning"),
    Word(r"(?<![._])fitted", "fine-tuned", TRAINING, "Camera.fitted changes its size"),
)


@functools.cache
def texts() -> dict[str, str]:
    """Text by path of all files that are checked, vendored ones left out."""
    files = [ROOT / "README.md"]
    for top in (*CODE, "docs"):
        files += sorted((ROOT / top).rglob("*"))
    return {
        path.relative_to(ROOT).as_posix(): path.read_text(encoding="utf-8")
        for path in files
        if path.suffix in SUFFIXES and "vendor" not in path.parts
    }


def found(word: Word) -> list[str]:
    """ "path:line: text" of each line that holds the word."""
    word_start = "(?:(?<![A-Za-z])|(?<=[a-z])(?=[A-Z]))"
    pattern = f"{word_start}(?i:{word.pattern})(?![a-z])"
    hits = []
    for path, text in texts().items():
        if any(path == top or path.startswith(top + "/") for top in word.where):
            for number, line in enumerate(text.splitlines(), 1):
                if re.search(pattern, line):
                    hits.append(f"{path}:{number}: {line.strip()[:100]}")
    return hits


@pytest.mark.parametrize("word", WORDS, ids=lambda word: word.pattern)
def test_word_was_given_up(word: Word) -> None:
    hits = found(word)
    shown = "\n".join(hits[:30])
    assert not hits, f"write instead: {word.instead} ({len(hits)} lines)\n{shown}"
