"""A job of the worker process: plain data, passed as JSON.

Also: progress of the worker process, in a small file that its parent reads.
"""

from __future__ import annotations

import json
import os
import shutil
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.base import threads
from stages.scene import Capture


@dataclass(frozen=True)
class CameraGuess:
    """Intrinsics as known before structure from motion.

    Args:
        width, height: of the photographs, pixels.
        focal_px: from EXIF, or None; of a face of a panorama it is exact.
        rig, turn: of a face, as in `scene.Face`; "" and () of other cameras.
    """

    width: int
    height: int
    focal_px: float | None
    rig: str = ""
    turn: tuple[float, ...] = ()


@dataclass(frozen=True)
class Job:
    """One step of structure from motion for P photographs.

    Args:
        step: one of those in `worker`.
        images_root: folder that `names` and `masks` are relative to.
        database: COLMAP's database.
        out: folder for the model of mapping (`sparse_model.save_model`).
        names: [P] in the capture's order, which fixes the image ids (position + 1).
        camera_of: [P] index into `cameras`.
        frame_of: [P] number of each photograph's frame, from 0: the faces of a panorama share one.
        cameras: known intrinsics.
        masks: [P] mask files, "" for none.
        seed: of RANSAC and the mapper.
        threads: how many to use.
        max_features, peak_threshold: of SIFT (Lowe 2004).
        matching: which pairs: "selected" by retrieval, "exhaustive" or "sequential".
        drop_stationary: drop matches that stay in place in the picture (a date stamp).
        loose: register photographs with fewer inliers.
        strongest_start: start mapping from `initial_pair.strongest_pair`.
        refine: refine the poses of known cameras.
        max_seconds: time limit of mapping.
        source: of a chunk: the database of the whole job; of "learned": that of SIFT.
        photographs, pairs: of a chunk: the positions to process; of "learned": the
            photographs to join; of known cameras: all pairs to match.
        known: of known cameras, each of which has one photograph: intrinsics [P, 4] fx, fy, cx, cy;
            world_to_camera [P, 4, 4]; rotations [P, 3, 3] from the axes of the frame to the
            camera's.
    """

    step: str
    images_root: str
    database: str
    out: str
    names: tuple[str, ...]
    camera_of: tuple[int, ...]
    frame_of: tuple[int, ...]
    cameras: tuple[CameraGuess, ...]
    masks: tuple[str, ...]
    seed: int = 0
    threads: int = 1
    max_features: int = 12288
    peak_threshold: float = 0.0045
    matching: str = "selected"
    drop_stationary: bool = False
    loose: bool = False
    strongest_start: bool = False
    refine: bool = False
    max_seconds: int = 3600
    source: str = ""
    photographs: tuple[int, ...] = ()
    pairs: tuple[tuple[int, int], ...] = ()
    known: dict[str, list[Any]] = field(default_factory=dict)

    @property
    def frames(self) -> NDArray[np.int64]:
        """[P] `frame_of` as an array."""
        return np.array(self.frame_of, np.int64)

    def write(self, path: Path) -> Path:
        path.write_text(json.dumps(asdict(self)), encoding="utf-8")
        return path

    @classmethod
    def read(cls, path: Path) -> Job:
        stored = json.loads(path.read_text(encoding="utf-8"))
        data: dict[str, Any] = {
            name: tuple(value) if isinstance(value, list) else value
            for name, value in stored.items()
        }
        data["pairs"] = tuple((first, second) for first, second in data["pairs"])
        cameras = (camera | {"turn": tuple(camera["turn"])} for camera in data["cameras"])
        data["cameras"] = tuple(CameraGuess(**camera) for camera in cameras)
        return cls(**data)


def job_of(capture: Capture, work: Path, seed: int, max_features: int, matching: str) -> Job:
    """The job of the standard configuration: photographs of the same key and size share a camera.

    matching: "auto", "exhaustive" or "sequential". See `Job` for the rest.
    """
    positions: dict[tuple[str, int, int], int] = {}
    guesses: list[CameraGuess] = []
    camera_of = []
    for photo in capture.photos:
        key = (photo.camera, photo.width, photo.height)
        if key not in positions:
            positions[key] = len(guesses)
            rig = (photo.face.rig, photo.face.turn) if photo.face else ("", ())
            guesses.append(CameraGuess(photo.width, photo.height, photo.focal_px, *rig))
        camera_of.append(positions[key])
    sources = list(dict.fromkeys(photo.source for photo in capture.photos))
    frame = {source: number for number, source in enumerate(sources)}
    return Job(
        step="",
        images_root=str(capture.folder.resolve()),
        database=str(work / "base.db"),
        out="",
        names=tuple(photo.image for photo in capture.photos),
        masks=tuple(photo.mask for photo in capture.photos),
        camera_of=tuple(camera_of),
        frame_of=tuple(frame[photo.source] for photo in capture.photos),
        cameras=tuple(guesses),
        seed=seed,
        threads=threads.count(),
        max_features=max_features,
        matching="selected" if matching == "auto" else matching,
    )


def prepare_work_folder(work: Path, job: Job) -> None:
    """Keep what an interrupted run left in `work` if it was the same job; clear it otherwise."""
    description = work / "description.json"
    # Locations and the number of threads change no result.
    same = {"images_root": "", "database": "", "out": "", "threads": 0}
    wanted = json.dumps(asdict(job) | same, sort_keys=True)
    try:
        unchanged = description.read_text(encoding="utf-8") == wanted
    except (OSError, ValueError):
        unchanged = False
    if not unchanged:
        shutil.rmtree(work, ignore_errors=True)
        work.mkdir(parents=True)
        description.write_text(wanted, encoding="utf-8")


def similarity_path(job: Job) -> Path:
    """File with the matches that pair selection found: similarity [P, P]."""
    return Path(job.database).with_suffix(".similarity.npz")


def vocabulary_path(job: Job) -> Path:
    """File with the vocabulary of the whole job: [W, 128]."""
    return Path(job.source or job.database).with_suffix(".vocabulary.npy")


def selected_pairs_path(job: Job) -> Path:
    """File with the pairs that the step "pair selection" selected to match next, as JSON."""
    return Path(job.database).with_suffix(".pairs.json")


def chunks_path(job: Job) -> Path:
    """Folder for finished chunks of the job."""
    return Path(job.database).with_suffix(".chunks")


def progress_path(job: Job) -> Path:
    """File with the worker's progress (`ProgressWriter`)."""
    return Path(job.database).with_name("progress.json")


_SECONDS = 0.2  # between two writes


class ProgressWriter:
    """Writes `progress_path`."""

    def __init__(self, job: Job) -> None:
        self._path = progress_path(job)
        self._next = 0.0

    def write(self, phase: str, done: int, total: int) -> None:
        """Record that `done` of `total` units of `phase` are finished; at most every 0.2 s, and
        always at the end."""
        now = time.monotonic()
        if now < self._next and done < total:
            return
        self._next = now + _SECONDS
        partial = self._path.with_name(self._path.name + ".partial")
        partial.write_text(json.dumps([phase, done, total]))
        os.replace(partial, self._path)


def read_progress(job: Job) -> tuple[str, int, int] | None:
    """(phase, done, total) as last written; None before the first time."""
    try:
        phase, done, total = json.loads(progress_path(job).read_text())
        return str(phase), int(done), int(total)
    except (OSError, ValueError, TypeError):
        return None
