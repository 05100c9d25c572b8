"""Large files are converted a block at a time: memory grows with the splats by little more than
their own arrays."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from stages import formats
from tests import processes
from tests.formats.truth import many_splats

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(sys.platform == "win32", reason="no resource module"),
]

# Below some hundred thousand splats, memory that the allocator keeps outweighs the splats' own.
FEW, MANY = 300_000, 1_000_000
BYTES_IN_MEMORY = 4 * (3 + 4 + 3 + 1 + 48) + 1  # of a splat of degree 3
# 2 GB for 5 million splats: reading back and comparing need a second copy of the splats (237 B),
# the index by which files are matched, errors by attribute and what is drawn.
BYTES_BEYOND = 400
_CONVERT = """
import resource, sys
from splatcli.app import app
app(["convert", *sys.argv[1:], "--quiet"], standalone_mode=False)
who = resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN
peak = max(resource.getrusage(one).ru_maxrss for one in who)
print(peak * (1 if sys.platform == "darwin" else 1024))
"""


def peak_bytes(source: Path, target: Path) -> int:
    """The most memory that one of the processes of a conversion held."""
    done = subprocess.run(
        processes.python(_CONVERT, str(source), str(target)), capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return int(done.stdout.split()[-1])


@pytest.fixture(scope="module")
def sources(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """(a file of FEW splats, one of MANY)."""
    folder = tmp_path_factory.mktemp("sources")
    paths = folder / "few.ply", folder / "many.ply"
    for path, count in zip(paths, (FEW, MANY), strict=True):
        formats.write(path, many_splats(count))
    return paths


@pytest.mark.slow
@pytest.mark.parametrize("suffix", ["splat", "glb", "usdz", "compressed.ply", "sog"])
def test_memory_grows_by_little_more_than_the_splats(
    tmp_path: Path, sources: tuple[Path, Path], suffix: str
) -> None:
    few, many = (peak_bytes(source, tmp_path / f"{source.stem}.{suffix}") for source in sources)
    assert many - few < (MANY - FEW) * (BYTES_IN_MEMORY + BYTES_BEYOND)
