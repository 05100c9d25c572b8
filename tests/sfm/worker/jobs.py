"""A job for the worker of structure from motion that has nothing to do."""

from __future__ import annotations

from pathlib import Path

from stages.sfm.worker.job import CameraGuess, Features, Photographs, Project, Sift


def job(folder: Path) -> Features:
    cameras = (CameraGuess(640, 480, None),)
    photographs = Photographs(folder, ("é 1.jpg",), ("",), (0,), (0,), cameras)
    return Features(Project(folder / "a.db", photographs), Sift())
