"""`python -m tests.faults --kills 200`: kills and full disks in every stage, and a table of ends.

With --write its rows replace those in docs/experiments/faults.md.
"""

from __future__ import annotations

import argparse
import itertools
import random
import re
import tempfile
from pathlib import Path

from tests.faults import full_disk, kills
from tests.faults.small_run import SmallRun, names, prepare

PAGE = Path(__file__).parents[2] / "docs" / "experiments" / "faults.md"
_TABLE = re.compile(r"(<!-- python -m tests.faults -->\n).*?(<!-- end of faults -->)", re.S)
_HEAD = (
    "| stage | points | runs killed | kills | the same bytes after | full disks "
    "| the same bytes after | room that is enough |\n|---|--:|--:|--:|--:|--:|--:|--:|\n"
)
_MOST_ROOM = 1 << 25  # bytes: no stage of the small run writes more


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=200, help="how many, over all stages")
    parser.add_argument("--disks", type=int, default=100, help="sizes of disks for each stage")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--write", action="store_true", help="write the table into the docs")
    parser.add_argument("stages", nargs="*", help="some of the stages")
    given = parser.parse_args()
    prepare()
    with tempfile.TemporaryDirectory(prefix="faults-") as place:
        folder = Path(place)
        run = SmallRun.made(folder / "whole")
        rows, wrong = dict[str, str](), list[str]()
        for stage in given.stages or names():
            share = given.kills // len(given.stages or names())
            points, hits, bad = _killed(run, stage, share, given.seed, folder / "work")
            full, smallest, faults = _filled(run, stage, given.disks, folder)
            wrong += [f"{stage}: {one}" for one in bad + faults]
            cells = (f"`{stage}`", points, share, hits, share - len(bad), full, full - len(faults))
            rows[stage] = f"| {' | '.join(map(str, cells))} | {smallest} |\n"
            print(rows[stage], end="", flush=True)
    for one in wrong:
        print(one)
    if given.write:
        _write(rows)
    raise SystemExit(bool(wrong))


def _write(rows: dict[str, str]) -> None:
    """Replace the rows of these stages in the table."""
    text = PAGE.read_text(encoding="utf-8")
    rows = {found[1]: found[0] for found in re.finditer(r"\| `(\w+)` .*\n", text)} | rows
    table = _HEAD + "".join(rows[stage] for stage in names() if stage in rows)
    PAGE.write_text(_TABLE.sub(lambda f: f[1] + table + f[2], text), encoding="utf-8")


def _killed(
    run: SmallRun, stage: str, share: int, seed: int, folder: Path
) -> tuple[int, int, list[str]]:
    """(points of the stage, kills that hit, what was wrong) of `share` runs, every third of which
    is killed again while it goes on."""
    points = kills.points(run, stage, folder)
    draw = random.Random(f"{seed} {stage}")
    chosen = draw.sample(points, min(share, len(points)))
    chosen += draw.choices(points, k=share - len(chosen))
    hits, wrong = 0, []
    for number, point in enumerate(chosen):
        again = None if number % 3 else draw.choice(points)
        hit, fault = kills.killed(run, point, again, folder)
        hits += hit
        if fault:
            wrong.append(f"killed at {point}, then {again}: {fault}")
    return len(points), hits, wrong


def _filled(run: SmallRun, stage: str, most: int, folder: Path) -> tuple[int, str, list[str]]:
    """(disks that became full, the first that did not, what was wrong)."""
    full, wrong = 0, list[str]()
    for room in itertools.islice(full_disk.sizes(_MOST_ROOM), most):
        end = full_disk.filled(run, stage, room, folder)
        if end == "enough":
            return full, f"{room >> 10} KiB", wrong
        if end == "no mount":
            return full, "file systems may not be mounted", wrong
        full += 1
        if end != "full":
            wrong.append(f"{room} bytes: {end}")
    return full, "more", wrong


if __name__ == "__main__":
    main()
