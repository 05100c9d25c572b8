"""Jobs for the worker on photographs of the sample capture."""

from __future__ import annotations

import shutil
from pathlib import Path
from threading import Event

from stages.sfm.worker.job import CameraGuess, Job
from stages.sfm.worker.process import run_worker
from tests.sfm.checks.bad_captures import SAMPLE

__all__ = ["SAMPLE", "sample_job", "work"]


def sample_job(folder: Path, photographs: int) -> Job:
    """Finding features of copies whose names have spaces."""
    names = []
    for number, source in enumerate(sorted(SAMPLE.glob("*.jpg"))[:photographs]):
        names.append(f"é {number}.jpg")
        shutil.copy(source, folder / names[-1])
    return Job(
        step="features",
        images_root=str(folder),
        database=str(folder / "base.db"),
        out="",
        names=tuple(names),
        camera_of=(0,) * len(names),
        frame_of=tuple(range(len(names))),
        cameras=(CameraGuess(640, 480, None),),
        masks=("",) * len(names),
        max_features=800,
    )


def work(job: Job) -> None:
    """Do the job's step in a worker process."""
    run_worker(job, Path(job.database).parent, Event(), 240.0, lambda: None)
