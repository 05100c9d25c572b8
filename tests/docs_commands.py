"""The commands that the documentation shows."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterable
from pathlib import Path

from tests.docs_tables import PAGES

_FENCE = re.compile(r"```bash\n(.*?)```", re.S)


def bash_lines(page: Path) -> list[str]:
    """Every command of a page's fenced bash blocks; `&&` separates two."""
    lines = []
    for block in _FENCE.findall(page.read_text(encoding="utf-8")):
        for line in block.replace("\\\n", " ").splitlines():
            lines += [part.strip() for part in line.removeprefix("$ ").split("&&")]
    return [line for line in lines if line and not line.startswith("#")]


def splat_commands(pages: Iterable[Path] = PAGES) -> list[list[str]]:
    """Words of each distinct `splat` command of the bash blocks."""
    return _words_of([line for page in pages for line in bash_lines(page)])


def inline_commands() -> list[list[str]]:
    """Words of each distinct `splat` command in running text."""
    texts = (re.sub(r"```.*?```", "", p.read_text(encoding="utf-8"), flags=re.S) for p in PAGES)
    return _words_of([line for text in texts for line in re.findall(r"`(splat [^`]*)`", text)])


def _words_of(lines: list[str]) -> list[list[str]]:
    words = [shlex.split(line, comments=True) for line in dict.fromkeys(lines)]
    return [each for each in words if each[0] == "splat"]
