"""Jobs of the worker process: one small message for each step, passed as JSON."""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass, is_dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

from stages.base import threads
from stages.scene import Capture
from stages.sfm.worker.pairs import Pair


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
class Photographs:
    """P photographs in the capture's order, which fixes their image ids (position + 1).

    Args:
        folder: that `names` and `masks` are relative to.
        names: [P].
        masks: [P] mask files, "" for none.
        camera_of: [P] index into `cameras`.
        frame_of: [P] number of each photograph's frame, from 0: the faces of a panorama share one.
        cameras: known intrinsics.
    """

    folder: Path
    names: tuple[str, ...]
    masks: tuple[str, ...]
    camera_of: tuple[int, ...]
    frame_of: tuple[int, ...]
    cameras: tuple[CameraGuess, ...]

    def __len__(self) -> int:
        return len(self.names)

    @property
    def frames(self) -> NDArray[np.int64]:
        """[P] `frame_of` as an array."""
        return np.array(self.frame_of, np.int64)


@dataclass(frozen=True)
class Project:
    """What all steps share.

    Args:
        database: COLMAP's database.
        photographs: that are in it.
        seed: of RANSAC and the mapper.
        threads: how many to use.
    """

    database: Path
    photographs: Photographs
    seed: int = 0
    threads: int = 1


@dataclass(frozen=True)
class Sift:
    """Settings of SIFT (Lowe 2004).

    Args:
        max_features: of a photograph.
        peak_threshold: of differences of blurred pictures, for white = 1.
    """

    max_features: int = 12288
    peak_threshold: float = 0.0045


@dataclass(frozen=True)
class KnownCameras:
    """Known cameras, each of one photograph.

    Args:
        intrinsics: [P, 4] fx, fy, cx, cy.
        world_to_camera: [P, 4, 4].
    """

    intrinsics: NDArray[np.float64]
    world_to_camera: NDArray[np.float64]


@dataclass(frozen=True)
class Job:
    """One step for one project; a subclass adds what its step needs."""

    step: ClassVar[str]
    project: Project

    def write(self, path: Path) -> Path:
        path.write_text(_encoded({"step": self.step, "job": self}), encoding="utf-8")
        return path

    @staticmethod
    def read(path: Path) -> Any:
        """The job that `write` wrote, of its own class."""
        stored = json.loads(path.read_text(encoding="utf-8"))
        kinds = {kind.step: kind for kind in Job.__subclasses__()}
        return _decoded(kinds[stored["step"]], stored["job"])


@dataclass(frozen=True)
class Features(Job):
    """Extract the features of all photographs."""

    step = "features"
    sift: Sift


@dataclass(frozen=True)
class Matching(Job):
    """Match and verify pairs. how: "auto" (pairs that look alike) or "exhaustive"."""

    step = "matching"
    how: str


@dataclass(frozen=True)
class Learned(Job):
    """Copy a database with SIFT's matches, and add learned features and their matches.

    Args:
        source: the database with SIFT's matches.
        positions: of the photographs to join to the others.
    """

    step = "learned"
    source: Path
    positions: tuple[int, ...]


@dataclass(frozen=True)
class Mapping(Job):
    """Find camera poses and points.

    Args:
        out: folder for the model (`sparse_model.save_model`).
        max_seconds: time limit.
        loose: register photographs with fewer inliers.
        strongest_start: start from `initial_pair.strongest_pair`.
    """

    step = "mapping"
    out: Path
    max_seconds: int
    loose: bool = False
    strongest_start: bool = False


@dataclass(frozen=True)
class Neighbours(Job):
    """Match and verify `pairs` of photographs with known cameras."""

    step = "neighbours"
    cameras: KnownCameras
    pairs: tuple[Pair, ...]


@dataclass(frozen=True)
class Triangulation(Job):
    """Check known poses against the matches, and triangulate points.

    Args:
        out: folder for the result.
        cameras: known cameras.
        refine: refine their poses.
    """

    step = "triangulation"
    out: Path
    cameras: KnownCameras
    refine: bool


def _encoded(value: object) -> str:
    """As JSON."""

    def json_value(part: Any) -> Any:
        if isinstance(part, np.ndarray):
            return part.tolist()
        return str(part) if isinstance(part, Path) else vars(part)

    return json.dumps(value, default=json_value, sort_keys=True)


def _decoded(kind: Any, value: Any) -> Any:
    """A value of JSON as an object of type `kind`."""
    if isinstance(kind, type) and is_dataclass(kind):
        kinds = get_type_hints(kind)
        return kind(**{name: _decoded(kinds[name], part) for name, part in value.items()})
    if get_origin(kind) is tuple:
        return tuple(_decoded(get_args(kind)[0], part) for part in value)
    if get_origin(kind) is np.ndarray:
        return np.array(value, np.float64)
    return Path(value) if kind is Path else value


def project_of(capture: Capture, work: Path, seed: int) -> Project:
    """The project of a capture. Photographs of the same key and size share a camera."""
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
    photographs = Photographs(
        folder=capture.folder.resolve(),
        names=tuple(photo.image for photo in capture.photos),
        masks=tuple(photo.mask for photo in capture.photos),
        camera_of=tuple(camera_of),
        frame_of=tuple(frame[photo.source] for photo in capture.photos),
        cameras=tuple(guesses),
    )
    return Project(work / "base.db", photographs, seed, threads.count())


def prepare_work_folder(work: Path, project: Project, *settings: object) -> None:
    """Keep what an interrupted run left in `work` if its project and settings were the same; clear
    the folder otherwise."""
    description = work / "description.json"
    # Locations and the number of threads change no result.
    photographs = replace(project.photographs, folder=Path())
    same = replace(project, database=Path(), photographs=photographs, threads=0)
    wanted = _encoded([same, *settings])
    try:
        unchanged = description.read_text(encoding="utf-8") == wanted
    except (OSError, ValueError):
        unchanged = False
    if not unchanged:
        shutil.rmtree(work, ignore_errors=True)
        work.mkdir(parents=True)
        description.write_text(wanted, encoding="utf-8")


def similarity_path(database: Path) -> Path:
    """File with the matches that pair selection found: similarity [P, P]."""
    return database.with_suffix(".similarity.npz")


def vocabulary_path(database: Path) -> Path:
    """File with the vocabulary of the features in `database`: [W, 128]."""
    return database.with_suffix(".vocabulary.npy")


def derived_paths(database: Path) -> tuple[Path, ...]:
    """Files beside a database that are computed from its features."""
    return similarity_path(database), vocabulary_path(database)
