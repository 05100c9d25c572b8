"""`python -m tests.fuzz.child LAYER COUNT FOLDER`: one layer's inputs, in a process that may die.

Each input lies in FOLDER while it is read, so that the parent has it when this process ends badly.
The last line of standard output is the tally, as JSON.
"""

from __future__ import annotations

import json
import os
import resource
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path

from hypothesis import HealthCheck, Phase, given, settings

from stages.base.errors import SplatError
from tests.fuzz.changes import damaged
from tests.fuzz.layers import LAYERS

MEMORY_BYTES = 2 << 30  # address space beyond what the process has before the first input
LIMIT_S = 10.0  # thousands of times what 40 splats take; a busy machine may be slow


@dataclass
class Tally:
    tried: int = 0
    read: int = 0
    refused: int = 0
    slowest_s: float = 0.0
    peak_mib: float = 0.0  # beyond what the process had before


def main(name: str, count: int, folder: Path) -> None:
    """Raises what a reader raises that is not its own error: then Hypothesis has made the input
    small."""
    layer = LAYERS[name]
    whole = layer.content()
    for beside, content in layer.beside().items():
        (folder / beside).parent.mkdir(parents=True, exist_ok=True)
        (folder / beside).write_bytes(content)
    path = folder / layer.name
    path.write_bytes(layer.pack(whole))
    assert layer.read(path) == layer.holds, f"{name}: undamaged, it does not come back"
    tally, before = Tally(), _limit_memory()

    @settings(
        max_examples=count,
        deadline=None,
        derandomize=True,
        database=None,
        phases=[Phase.generate, Phase.shrink],
        suppress_health_check=list(HealthCheck),
    )
    @given(content=damaged(whole, text=layer.text))
    def attempt(content: bytes) -> None:
        path.write_bytes(layer.pack(content))
        begun = time.monotonic()
        tally.tried += 1
        try:
            layer.read(path)
            tally.read += 1
        except SplatError as refusal:
            if isinstance(refusal.__cause__, MemoryError):
                raise AssertionError("it believed a huge count") from refusal
            tally.refused += 1
        seconds = time.monotonic() - begun
        tally.slowest_s = max(tally.slowest_s, round(seconds, 3))
        assert seconds < LIMIT_S

    attempt()
    tally.peak_mib = round((_peak_bytes() - before) / 2**20, 1)
    print(json.dumps(asdict(tally)))


def _limit_memory() -> int:
    """Peak resident bytes until now; from here on a reader that believes a huge count fails."""
    pages = int(Path("/proc/self/statm").read_text().split()[0]) if os.name == "posix" else 0
    hard = resource.getrlimit(resource.RLIMIT_AS)[1]
    limit = pages * resource.getpagesize() + MEMORY_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (limit, hard))
    return _peak_bytes()


def _peak_bytes() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), Path(sys.argv[3]))
