"""Cameras of long walks against the truth: `python -m tests.benchmarks.walks FOLDER --photos 50`.

Takes photographs on walks of so many photographs (see `hall`), or with `--run RUN` on a way through
a finished run's scene; finds their cameras; and prints CPU seconds (of all processes), peak memory,
what was placed, how far from the truth, how far the end of the walk drifted from its beginning, and
for how long at most progress stood still in each phase. Photographs are kept in FOLDER.
"""

from __future__ import annotations

import argparse
import itertools
import resource
import shutil
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stages.base.memory import PeakMemory
from stages.base.stage import Numbers, Report
from stages.ingest import stage as ingest
from stages.ingest.settings import IngestSettings
from stages.scene import View
from stages.sfm import stage as sfm
from stages.sfm.settings import SfmSettings
from tests.benchmarks.hall import Walk, in_hall, through_run
from tests.sfm.truth import centres, similarity

ENDS = 10  # photographs at the beginning and at the end, whose places tell the drift
REPORTED = (
    "points",
    *(f"pairs_{what}" for what in ("matched", "verified")),
    *(f"{step}_seconds" for step in ("features", "matching", "mapping")),
)


class Clock:
    """Listens to progress. reported: (seconds, label, done, total) of each change."""

    def __init__(self) -> None:
        self._begun = time.monotonic()
        self.reported: list[tuple[float, str, int, int]] = [(0.0, "", 0, 0)]

    def __call__(self, label: str, done: int, total: int, numbers: Numbers) -> None:
        if (label, done, total) != self.reported[-1][1:]:
            self.reported.append((time.monotonic() - self._begun, label, done, total))

    def standstills(self) -> dict[str, tuple[float, int]]:
        """The longest time (seconds) for which each label stood still, and how much was done by
        then; "" before the first."""
        self("the end", 0, 0, {})
        longest: dict[str, tuple[float, int]] = {}
        for (begun, label, done, _), (ended, *_) in itertools.pairwise(self.reported):
            longest[label] = max(longest.get(label, (0.0, 0)), (round(ended - begun, 1), done))
        return longest

    def time_left(self) -> dict[str, tuple[float, float]]:
        """Of each label, when half is done: (seconds left at the pace so far, true seconds)."""
        found = {}
        for label in dict.fromkeys(label for _, label, _, total in self.reported if total):
            mine = [(at, done / total) for at, name, done, total in self.reported if name == label]
            (begun, first), (ended, _) = mine[0], mine[-1]
            half = next(((at, share) for at, share in mine if share >= 0.5), mine[-1])
            if half[1] > first:
                guessed = (half[0] - begun) / (half[1] - first) * (1 - half[1])
                found[label] = round(guessed, 1), round(ended - half[0], 1)
        return found


def used() -> float:
    """CPU seconds of this process and of those that it waited for."""
    both = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(usage.ru_utime + usage.ru_stime for usage in both)


def errors_mm(views: Sequence[View], true: NDArray[np.float64]) -> NDArray[np.float64]:
    """[P, 3] of the placed cameras' positions, in thousandths of a unit of `true` [P, 4, 4]."""
    there = centres(true[[int(Path(view.name).stem) for view in views]])
    have = centres(np.array([view.camera.world_to_camera for view in views]))
    turn, scale, shift = similarity(have, there)
    away: NDArray[np.float64] = 1000 * (scale * have @ turn.T + shift - there)
    return away


def measure(walk: Walk, folder: Path) -> str:
    """Find the cameras of one walk; what to print."""
    for stage in ("1", "2"):
        shutil.rmtree(folder / stage, ignore_errors=True)
    walk.take(folder / "photos")
    settings = IngestSettings()
    capture = ingest.run({"photos": folder / "photos"}, settings, folder / "1", Report())
    clock = Clock()
    before, report = used(), Report(listener=clock)
    with PeakMemory() as memory:
        found = sfm.run({"ingest": capture}, SfmSettings(), folder / "2", report)
    seconds = used() - before
    away = errors_mm(found.views, walk.poses)
    lengths = np.linalg.norm(away, axis=1)
    drift = np.linalg.norm(away[-ENDS:].mean(axis=0) - away[:ENDS].mean(axis=0))
    figures = {name: report.metrics[name] for name in REPORTED}
    return (
        f"{len(walk.poses)}: {seconds:.0f} CPU s, {memory.peak_mib:.0f} MiB, "
        f"{len(lengths)} placed, {lengths.mean():.2f} ({lengths.max():.2f}) thousandths off, "
        f"{drift:.2f} from end to end, {figures}, stood still {clock.standstills()} s, "
        f"left at half (guessed, true) {clock.time_left()} s"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--photos", type=int, nargs="+", default=[50, 100, 200, 400])
    parser.add_argument("--width", type=int, default=400, help="of a photograph (pixels)")
    parser.add_argument("--run", type=Path, help="a finished run whose scene is walked through")
    options = parser.parse_args()
    for count in options.photos:
        run, width = options.run, options.width
        walk = through_run(run, count, width) if run else in_hall(count, width)
        print(measure(walk, options.folder / str(count)), flush=True)


if __name__ == "__main__":
    main()
