"""`python -m stages.structure.worker job.json`: one step of structure from motion.

COLMAP aborts the process on some inputs, and importing it before zlib corrupts the heap where
Python links the system's zlib. In a process of its own neither can take a run down.
"""

import zlib  # noqa: F401, I001 - must come before pycolmap: see above

import ctypes
import os
import signal
import sys
import threading
from pathlib import Path

from stages.structure.job import Job


def main(arguments: list[str]) -> int:
    """Run the job named on the command line. Returns the exit status (0: done)."""
    _die_with_parent()
    job = Job.read(Path(arguments[0]))
    from stages.structure import features, known_worker, mapping, matching

    steps = {
        "features": features.extract,
        "matching": matching.match,
        "mapping": mapping.map_photographs,
        "neighbours": known_worker.match_neighbours,
        "triangulation": known_worker.triangulate,
    }
    steps[job.step](job)
    return 0


def _die_with_parent() -> None:
    """End when the parent does: by the kernel on Linux, and everywhere when standard input, which
    the parent holds open, comes to its end."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG
    threading.Thread(target=_exit_at_end_of_input, daemon=True).start()


def _exit_at_end_of_input() -> None:
    while os.read(0, 4096):
        pass
    os._exit(1)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
