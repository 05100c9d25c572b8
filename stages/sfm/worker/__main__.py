"""`python -m stages.sfm.worker.__main__ job.json`: one step of structure from motion.

COLMAP aborts the process on some inputs, and importing it before zlib corrupts the heap if Python
links the system's zlib. In a separate process neither can end a run.
"""

import zlib  # noqa: F401, I001 - must come before pycolmap: see above

import sys
from pathlib import Path

from stages.base.parent import die_with_parent
from stages.sfm.worker.job import Job


def main(arguments: list[str]) -> int:
    """Run the job named on the command line. Returns the exit status (0: done)."""
    die_with_parent()
    job = Job.read(Path(arguments[0]))
    # COLMAP loads once the process ends with its parent.
    from stages.sfm.known import triangulation
    from stages.sfm.worker import features, mapping, matching

    steps = {
        "features": features.extract_features,
        "matching": matching.match_all,
        "mapping": mapping.map_photographs,
        # with known cameras
        "neighbours": triangulation.match_neighbours,
        "triangulation": triangulation.triangulate,
        # with an executor
        "pair selection": matching.select_pairs,
        "features chunk": features.extract_chunk,
        "matching chunk": matching.match_chunk,
        "learned": _match_learned,
    }
    steps[job.step](job)
    return 0


def _match_learned(job: Job) -> None:
    from stages.sfm.learned import joining  # imports torch, which takes seconds

    joining.match_learned(job)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
