"""Jobs for the worker on photographs of the sample capture."""

from __future__ import annotations

import shutil
from pathlib import Path
from threading import Event

from stages.sfm.worker.job import CameraGuess, Job, Photographs, Project, Sift
from stages.sfm.worker.process import run_worker
from tests.sfm.checks.bad_captures import SAMPLE

__all__ = ["SAMPLE", "SIFT", "sample_project", "work"]

SIFT = Sift(max_features=800)


def sample_project(folder: Path, photographs: int) -> Project:
    """A project of copies whose names have spaces."""
    names = []
    for number, source in enumerate(sorted(SAMPLE.glob("*.jpg"))[:photographs]):
        names.append(f"é {number}.jpg")
        shutil.copy(source, folder / names[-1])
    found = Photographs(
        folder,
        names=tuple(names),
        masks=("",) * len(names),
        camera_of=(0,) * len(names),
        frame_of=tuple(range(len(names))),
        cameras=(CameraGuess(640, 480, None),),
    )
    return Project(folder / "base.db", found)


def work(job: Job) -> None:
    """Do the job's step in a worker process."""
    run_worker(job, job.project.database.parent, Event(), 240.0, lambda: None)
