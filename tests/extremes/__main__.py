"""Measure every row of the extremes table and print it.

python -m tests.extremes [--write docs/experiments/extremes.md]
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from tests.extremes.table import listing


def main() -> int:
    """0 if everything holds that should."""
    parser = argparse.ArgumentParser(prog="python -m tests.extremes", description=__doc__)
    parser.add_argument("--write", type=Path, help="also write the table to this Markdown file")
    arguments = parser.parse_args()
    text = listing()
    print(text)
    if arguments.write:
        arguments.write.write_text(text, encoding="utf-8")
    return int("FAILS" in text)


if __name__ == "__main__":
    sys.exit(main())
