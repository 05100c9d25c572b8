"""Damaged files for every reader, and a table of what became of them.

`python -m tests.fuzz --inputs 1000000 --kept FOLDER --jobs 8` is a night's work. The same command
goes on where a stopped one was. --write puts the table of FOLDER into docs/experiments/formats.md.
"""

from __future__ import annotations

import argparse
import platform
import re
import sys
from concurrent.futures import ThreadPoolExecutor
from datetime import date
from pathlib import Path

from tests.fuzz.batch import UntriedError, fuzz, journal, total
from tests.fuzz.cost import CPU_LIMIT_S, PEAK_LIMIT_MIB
from tests.fuzz.layers import LAYERS

PAGE = Path(__file__).parents[2] / "docs" / "experiments" / "formats.md"
_TABLE = re.compile(r"(<!-- fuzz: begin -->\n).*?(<!-- fuzz: end -->)", re.S)


def table(kept: Path) -> str:
    """In Markdown, with the conditions."""
    every = journal(kept)
    totals = [total(mine) for name in LAYERS if (mine := [t for t in every if t.layer == name])]
    beaten = sum(len(t.beaten) for t in totals)
    lines = [
        "| what is damaged | inputs | read | refused | CPU seconds, most | MiB, most |",
        "|---|---|---|---|---|---|",
        *(
            f"| {t.layer} | {t.tried} | {t.read} | {t.refused} | {t.cpu_s:.3f} | {t.peak_mib:.0f} |"
            for t in totals
        ),
        "",
        f"{sum(t.tried for t in totals)} inputs, of which {beaten} crashed a reader, took more than"
        f" {CPU_LIMIT_S:.0f} CPU seconds or {PEAK_LIMIT_MIB:.0f} MiB, or raised anything but its"
        f" error. Python {platform.python_version()}, {platform.system()} {platform.machine()},"
        f" {date.today()}.",
    ]
    return "\n".join(lines) + "\n"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--inputs", type=int, default=2000, help="damaged files for each layer")
    parser.add_argument("--kept", type=Path, default=Path("fuzz"), help="journal, seeds, failures")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--write", action="store_true", help=f"the table into {PAGE.name}")
    parser.add_argument("layers", nargs="*", help=f"some of: {', '.join(LAYERS)}")
    given = parser.parse_args()
    given.kept.mkdir(parents=True, exist_ok=True)

    def run(name: str) -> int:
        beaten = 0
        try:
            for tally in fuzz(name, given.inputs, given.kept.resolve()):
                beaten += len(tally.beaten)
                for file, why in tally.beaten:
                    print(f"{name}: {file}: {why}", file=sys.stderr, flush=True)
        except UntriedError as error:
            print(error, file=sys.stderr, flush=True)
            beaten += 1
        return beaten

    with ThreadPoolExecutor(given.jobs) as pool:
        beaten = sum(pool.map(run, given.layers or LAYERS))
    text = table(given.kept)
    print(text)
    if given.write:
        page = PAGE.read_text(encoding="utf-8")
        PAGE.write_text(_TABLE.sub(lambda m: m[1] + text + m[2], page), encoding="utf-8")
    return int(beaten > 0)


if __name__ == "__main__":
    raise SystemExit(main())
