"""`python -m tests.fuzz --inputs 2000`: damaged files for every reader, and a table of the ends."""

from __future__ import annotations

import argparse

from rich.console import Console

from tests.fuzz.batch import BeatenError, fuzz
from tests.fuzz.layers import LAYERS


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--inputs", type=int, default=2000, help="damaged files for each layer")
    parser.add_argument("layers", nargs="*", help=f"some of: {', '.join(LAYERS)}")
    given = parser.parse_args()
    console = Console()
    print("| what is damaged | inputs | read | refused | slowest | memory, most |")
    print("|---|---|---|---|---|---|")
    tried, beaten = 0, []
    for name in given.layers or LAYERS:
        try:
            tally = fuzz(name, given.inputs)
        except BeatenError as failure:
            beaten.append(str(failure))
            print(f"| {name} | **beaten** | | | | |", flush=True)
            continue
        tried += tally.tried
        figures = f"{tally.tried} | {tally.read} | {tally.refused} | {tally.slowest_s:.2f} s"
        print(f"| {name} | {figures} | {max(0.0, tally.peak_mib):.0f} MiB |", flush=True)
    print(f"\n{tried} inputs, {len(beaten)} readers beaten")
    for words in beaten:
        console.print(words, markup=False)
    raise SystemExit(bool(beaten))


if __name__ == "__main__":
    main()
