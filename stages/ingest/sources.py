"""The files of a capture: which kinds there are, and how their names are compared and ordered."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

from stages.scene.capture import PHOTOS_FOLDER

LOSSY = frozenset({".jpg", ".jpeg", ".jpe", ".jfif", ".webp", ".heic", ".heif", ".hif", ".avif"})
LOSSLESS = frozenset({".png", ".tif", ".tiff", ".bmp"})
PICTURES = LOSSY | LOSSLESS
VIDEO = frozenset(
    {".mov", ".mp4", ".m4v", ".avi", ".mkv", ".webm", ".mts", ".m2ts", ".3gp", ".mpg", ".mpeg",
     ".wmv", ".insv", ".gif"}
)  # fmt: skip
RAW = frozenset(
    {".dng", ".cr2", ".cr3", ".crw", ".nef", ".nrw", ".arw", ".srf", ".sr2", ".raf", ".orf",
     ".rw2", ".pef", ".srw", ".x3f", ".3fr", ".erf", ".iiq", ".kdc", ".mrw", ".raw", ".rwl"}
)  # fmt: skip
OTHER_PICTURES = frozenset(
    {".psd", ".xcf", ".svg", ".pdf", ".exr", ".hdr", ".jxl", ".jp2", ".j2k", ".tga", ".ppm",
     ".pgm", ".eps", ".ai", ".ico", ".insp"}
)  # fmt: skip
RAW_ADVICE = "Export raw files as JPEG or TIFF first, all with the same white balance and exposure."


@dataclass(frozen=True)
class Source:
    """A file to read.

    Args:
        path: where it is.
        name: relative to the photographs' folder, with "/".
        image: name of its normalised picture, relative to the capture's folder; of a video, the
            folder of its frames.
    """

    path: Path
    name: str
    image: str


@dataclass(frozen=True)
class DepthFile:
    """A photograph's depth map. unit: metres of one step of its values; 0 if its kind decides.
    others: more maps of the same photograph."""

    path: Path
    unit: float = 0.0
    others: tuple[Path, ...] = ()


@dataclass(frozen=True)
class Findings:
    """What a folder holds.

    Args:
        sources: photographs, by their names' endings, in natural order.
        videos: to take frames from.
        raws, other_pictures: names of files that are not read. These and `videos` leave out files
            that share their name with a photograph (IMG_1.NEF, or a live picture's IMG_1.MOV,
            beside IMG_1.JPG).
        beside_frames: names of pictures beside the frames of a 3D Scanner App scan, which are no
            photographs.
        others: how many files are something else.
        not_files: why an entry is no file: broken links, links to folders, pipes and devices, by
            their names.
        masks: mask files by the name of their photograph.
        stray_masks: mask files that belong to no photograph.
        masks_as_stored, depths_as_stored: whether masks and depth maps whose proportions do not
            tell have the orientation of the stored photographs, and not the upright one.
        depths: depth maps by the name of their photograph.
        stray_depths: depth maps that belong to no photograph.
        unused_depths: depth maps beside their photographs, whose folder was not named for them.
    """

    sources: tuple[Source, ...]
    videos: tuple[Source, ...]
    raws: tuple[str, ...]
    other_pictures: tuple[str, ...]
    others: int
    not_files: Mapping[str, str] = field(default_factory=dict)
    masks: Mapping[str, Path] = field(default_factory=dict)
    stray_masks: tuple[str, ...] = ()
    masks_as_stored: bool = False
    depths_as_stored: bool = False
    depths: Mapping[str, DepthFile] = field(default_factory=dict)
    stray_depths: tuple[str, ...] = ()
    unused_depths: tuple[str, ...] = ()
    beside_frames: tuple[str, ...] = ()


def folder_beside(photos: Path, names: Iterable[str]) -> Path | None:
    """The first folder of these names beside the photographs' own; None if there is none."""
    near = (photos.absolute().parent / name for name in names)
    return next((path for path in near if path.is_dir() and path != photos.absolute()), None)


def suffix_of(name: str) -> str:
    """The ending of a name, lower case: ".jpg"."""
    return PurePosixPath(name).suffix.lower()


def stem_of(name: str) -> str:
    """A name without its ending, case-folded, with its folders."""
    return str(PurePosixPath(name).with_suffix("")).casefold()


def natural_key(name: str) -> tuple[list[tuple[int, int, str]], str]:
    """Sorts IMG_2 before IMG_10, folder by folder; ties are broken by the name itself."""
    parts: list[tuple[int, int, str]] = []
    for level in name.casefold().split("/"):
        for digits, text in re.findall(r"([0-9]+)|([^0-9]+)", level):
            parts.append((1, int(digits), "") if digits else (2, 0, text))
        parts.append((0, 0, ""))
    return parts, name


def picture_names(names: Iterable[str]) -> dict[str, str]:
    """The name of each photograph's normalised picture: all different.

    A name that can stay as it is stays. Of the others, those that would clash with a name already
    given, also on file systems that ignore case, are numbered.
    """
    wanted = {name: _wanted_name(name) for name in names}
    taken: set[str] = set()
    given: dict[str, str] = {}
    for name in sorted(wanted, key=lambda name: (wanted[name] != name, natural_key(name))):
        path = PurePosixPath(wanted[name])
        candidate, number = path, 2
        while _folded(candidate) in taken:
            candidate = path.with_name(f"{path.stem}-{number}{path.suffix}")
            number += 1
        taken.add(_folded(candidate))
        given[name] = f"{PHOTOS_FOLDER}{candidate}"
    return given


def _wanted_name(name: str) -> str:
    suffix = suffix_of(name)
    if suffix in (".jpg", ".jpeg", ".png") or suffix in VIDEO:
        return name
    return str(PurePosixPath(name).with_suffix(".png" if suffix in LOSSLESS else ".jpg"))


def _folded(path: PurePosixPath) -> str:
    return unicodedata.normalize("NFC", str(path)).casefold()
