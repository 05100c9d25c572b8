"""A job for the worker of structure from motion that has nothing to do."""

from __future__ import annotations

from pathlib import Path

from stages.sfm.worker.job import CameraGuess, Job


def job(folder: Path) -> Job:
    return Job(
        step="features",
        images_root=str(folder),
        database=str(folder / "a.db"),
        out="",
        names=("é 1.jpg",),
        camera_of=(0,),
        frame_of=(0,),
        cameras=(CameraGuess(640, 480, None),),
        masks=("",),
    )
