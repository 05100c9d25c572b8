"""What the worker process is told: plain data that travels as JSON."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path

STEPS = (
    *("features", "matching", "mapping"),
    *("neighbours", "triangulation"),  # of known cameras
    *("choosing", "features share", "matching share"),  # where others help
)


@dataclass(frozen=True)
class CameraGuess:
    """A camera as known before structure from motion. focal_px: from EXIF, or None."""

    width: int
    height: int
    focal_px: float | None


@dataclass(frozen=True)
class Job:
    """One step of structure from motion.

    step: one of `STEPS`. images_root: folder that `names` are relative to. database: COLMAP's.
    out: where mapping leaves its model (`sparse_model.save_model`). progress: where the worker says
    how far it is (`ticks`).
    names [P] in order of the capture, which fixes the image ids (position + 1);
    camera_of [P] position in `cameras` of each photograph's camera.
    masks [P] of the photographs, relative to images_root, "" for none; () where none has one.
    max_features, peak_threshold: of SIFT (Lowe 2004). matching: "chosen" by a first
    look, "exhaustive" or "sequential".
    drop_stationary: leave out matches that stay in place in the picture (a date stamp).
    mapper: "incremental" or "global". loose: register photographs with fewer matches.
    other_pair: start from another pair of photographs than COLMAP would. refine: move the known
    cameras to where the matches want them. max_seconds: of mapping.
    Of a share: source: the database of the whole job; photographs, or pairs: the positions that it
    is about.
    """

    step: str
    images_root: str
    database: str
    out: str
    progress: str
    names: tuple[str, ...]
    camera_of: tuple[int, ...]
    cameras: tuple[CameraGuess, ...]
    masks: tuple[str, ...] = ()
    seed: int = 0
    threads: int = 1
    max_features: int = 12288
    peak_threshold: float = 0.0045
    matching: str = "chosen"
    drop_stationary: bool = False
    mapper: str = "incremental"
    loose: bool = False
    other_pair: bool = False
    refine: bool = False
    max_seconds: int = 3600
    source: str = ""
    photographs: tuple[int, ...] = ()
    pairs: tuple[tuple[int, int], ...] = ()

    def write(self, path: Path) -> Path:
        path.write_text(json.dumps(asdict(self), ensure_ascii=False), encoding="utf-8")
        return path

    @classmethod
    def read(cls, path: Path) -> Job:
        data = json.loads(path.read_text(encoding="utf-8"))
        data["names"] = tuple(data["names"])
        data["camera_of"] = tuple(data["camera_of"])
        data["masks"] = tuple(data["masks"])
        data["photographs"] = tuple(data["photographs"])
        data["pairs"] = tuple((first, second) for first, second in data["pairs"])
        data["cameras"] = tuple(CameraGuess(**camera) for camera in data["cameras"])
        return cls(**data)


def known_cameras_path(job: Job) -> Path:
    """Of the steps "neighbours" and "triangulation": what is known of the cameras of `job.names`.
    intrinsics [V, 4] fx, fy, cx, cy; sizes [V, 2]; world_to_camera [V, 4, 4]; pairs [Q, 2]."""
    return Path(job.database).with_suffix(".known.npz")


def compared_pairs_path(job: Job) -> Path:
    """Where matching says how many pairs it looked at before it chose some."""
    return Path(job.database).with_suffix(".looked")


def similarity_path(job: Job) -> Path:
    """Where matching keeps what its first look found: alike [P, P]."""
    return Path(job.database).with_suffix(".alike.npz")


def vocabulary_path(job: Job) -> Path:
    """Where matching keeps the vocabulary of the whole job: [W, 128]."""
    return Path(job.source or job.database).with_suffix(".words.npy")


def selected_pairs_path(job: Job) -> Path:
    """Where the step "choosing" leaves the pairs to match next, as JSON."""
    return Path(job.database).with_suffix(".chosen.json")


def chunks_path(job: Job) -> Path:
    """The folder for finished shares of the job."""
    return Path(job.database).with_suffix(".shares")
