"""`python -m stages.sfm.worker.__main__ job.json`: one step of structure from motion.

COLMAP aborts the process on some inputs, and importing it before zlib corrupts the heap if Python
links the system's zlib. In a separate process neither can end a run.
"""

import zlib  # noqa: F401, I001 - must come before pycolmap: see above

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from stages.base.parent import die_with_parent
from stages.sfm.worker import job as jobs


def main(arguments: list[str]) -> int:
    """Run the job named on the command line. Returns the exit status (0: done)."""
    die_with_parent()
    job = jobs.Job.read(Path(arguments[0]))
    # COLMAP loads once the process ends with its parent.
    from stages.sfm.known import triangulation
    from stages.sfm.worker import features, mapping, matching

    steps: dict[type[jobs.Job], Callable[[Any], None]] = {
        jobs.Features: features.extract_features,
        jobs.Matching: matching.match_all,
        jobs.Learned: _match_learned,
        jobs.Mapping: mapping.map_photographs,
        # with known cameras
        jobs.Neighbours: triangulation.match_neighbours,
        jobs.Triangulation: triangulation.triangulate,
    }
    steps[type(job)](job)
    return 0


def _match_learned(job: jobs.Learned) -> None:
    from stages.sfm.learned import joining  # imports torch, which takes seconds

    joining.match_learned(job)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
