"""Which files are photographs or videos, by name; and what each will be called afterwards."""

from __future__ import annotations

import os
import re
import unicodedata
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

from stages.base.errors import Family, SplatError
from stages.base.text import counted
from stages.photos import masks
from stages.scene.capture import PHOTOS_FOLDER

LOSSY = frozenset({".jpg", ".jpeg", ".jpe", ".jfif", ".webp", ".heic", ".heif", ".hif", ".avif"})
LOSSLESS = frozenset({".png", ".tif", ".tiff", ".bmp"})
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


@dataclass(frozen=True)
class Source:
    """A file to read. path: where it is. name: relative to the photographs' folder, posix style.

    image: what its normalised picture is called, relative to the capture's folder; of a video, the
    folder of its frames.
    """

    path: Path
    name: str
    image: str


@dataclass(frozen=True)
class Findings:
    """What a folder holds. sources: photographs by their names' endings, in natural order.

    videos: to take frames from. raws, other_pictures: names of files that are not read. All less
    those that share their name with a photograph (IMG_1.NEF, or a live picture's IMG_1.MOV, beside
    IMG_1.JPG). others: how many files are something else.
    masks: files by the name of the photograph that they belong to. stray_masks: files among the
    masks that belong to no photograph.
    """

    sources: tuple[Source, ...]
    videos: tuple[Source, ...]
    raws: tuple[str, ...]
    other_pictures: tuple[str, ...]
    others: int
    masks: Mapping[str, Path] = field(default_factory=dict)
    stray_masks: tuple[str, ...] = ()


def find(folder: Path, more_masks: Path | None = None) -> Findings:
    """Look through `folder` and its sub-folders; hidden files and folders are passed over. In the
    place of a folder, a video counts as a folder that holds it. more_masks: a folder of masks
    besides those in `folder`.

    Links to folders are not followed, so that a loop cannot trap the search. Raises SplatError
    when the folder is missing, is another file, cannot be listed or holds no photograph or video.
    """
    if folder.is_file() and folder.suffix.lower() in VIDEO:
        name = _printable(Path(folder.name))
        return Findings((), (Source(folder, name, f"{PHOTOS_FOLDER}{name}"),), (), (), 0)
    _check_folder(folder)
    files: dict[str, Path] = {}
    for path in _walk(folder):
        files[_printable(path.relative_to(folder))] = path
    mask_of, stray = _masks_taken_out(files, folder, more_masks)
    names = sorted(files, key=natural_key)
    photographs = [name for name in names if _suffix(name) in LOSSY | LOSSLESS]
    stems = {_stem(name) for name in photographs}
    alone = [name for name in names if _stem(name) not in stems]
    kinds = {
        kind: tuple(name for name in alone if _suffix(name) in suffixes)
        for kind, suffixes in (("video", VIDEO), ("raw", RAW), ("other", OTHER_PICTURES))
    }
    images = picture_names([*photographs, *kinds["video"]])
    found = Findings(
        sources=tuple(Source(files[name], name, images[name]) for name in photographs),
        videos=tuple(Source(files[name], name, images[name]) for name in kinds["video"]),
        raws=kinds["raw"],
        other_pictures=kinds["other"],
        others=len(names) - len(photographs) - sum(len(kind) for kind in kinds.values()),
        masks=mask_of,
        stray_masks=stray,
    )
    if not found.sources and not found.videos:
        raise _no_photographs(folder, found)
    return found


def _masks_taken_out(
    files: dict[str, Path], folder: Path, apart: Path | None
) -> tuple[dict[str, Path], tuple[str, ...]]:
    """(mask by photograph's name, masks of none). They are removed from `files`: those in a folder
    called masks, those of `apart` where that lies within, and those beside their photographs."""
    apart = apart.resolve() if apart is not None else None
    inside = {
        name: name.partition("/")[2]
        for name in files
        if name.casefold().startswith(f"{masks.FOLDER}/")
    }
    if len(inside) == len(files):
        inside = {}  # whoever names such a folder's parent alone wants them as photographs
    found = {short: files.pop(name) for name, short in inside.items()}
    if apart is not None and apart.is_dir() and apart != folder.resolve():
        for path in _walk(apart):
            found[_printable(path.relative_to(apart))] = path
        for name in [name for name, path in files.items() if path.resolve().is_relative_to(apart)]:
            del files[name]
    found = {name: path for name, path in found.items() if _suffix(name) in masks.MASK_SUFFIXES}
    pictures = [name for name in files if _suffix(name) in LOSSY | LOSSLESS]
    beside = masks.beside(pictures)
    paired = masks.paired((name for name in pictures if name not in beside), found)
    for mask, photograph in beside.items():
        paired.setdefault(photograph, files.pop(mask))
    used = set(paired.values())
    stray = (name for name, path in found.items() if path not in used)
    return paired, tuple(sorted(stray, key=natural_key))


def natural_key(name: str) -> tuple[list[tuple[int, int, str]], str]:
    """Sorts IMG_2 before IMG_10, folder by folder; ties are broken by the name itself."""
    parts: list[tuple[int, int, str]] = []
    for level in name.casefold().split("/"):
        for digits, text in re.findall(r"([0-9]+)|([^0-9]+)", level):
            parts.append((1, int(digits), "") if digits else (2, 0, text))
        parts.append((0, 0, ""))
    return parts, name


def picture_names(names: Iterable[str]) -> dict[str, str]:
    """What the normalised picture of each photograph is called: no two alike.

    Names that can stay as they are stay; of the others, those that would clash with a name already
    given (also on disks that do not tell "A" from "a") are numbered.
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
    path = PurePosixPath(name)
    suffix = path.suffix.lower()
    if suffix in (".jpg", ".jpeg", ".png") or suffix in VIDEO:
        return name
    return str(path.with_suffix(".png" if suffix in LOSSLESS else ".jpg"))


def _folded(path: PurePosixPath) -> str:
    return unicodedata.normalize("NFC", str(path)).casefold()


def _walk(folder: Path) -> Iterable[Path]:
    def refuse(error: OSError) -> None:
        raise SplatError(
            "ingest-folder-unreadable",
            given=f"{error.filename} cannot be listed: {error.strerror}.",
            wanted="A folder that may be read, with all its sub-folders.",
            hint="Change its permissions, or move the photographs elsewhere.",
            family=Family.RESOURCES,
        ) from error

    for place, folders, files in os.walk(folder, onerror=refuse):
        folders[:] = [name for name in folders if not name.startswith(".") and name != "__MACOSX"]
        for name in files:
            path = Path(place, name)
            if not name.startswith(".") and path.is_file():
                yield path


def _printable(relative: Path) -> str:
    """The path with /; bytes that are no UTF-8 are spelt out, so that JSON can hold it."""
    return os.fsencode(relative.as_posix()).decode("utf-8", "backslashreplace")


def _suffix(name: str) -> str:
    return PurePosixPath(name).suffix.lower()


def _stem(name: str) -> str:
    return str(PurePosixPath(name).with_suffix("")).casefold()


def _check_folder(folder: Path) -> None:
    if not folder.exists():
        raise SplatError(
            "ingest-no-such-folder",
            given=f"{folder} does not exist.",
            wanted="A folder of photographs, or a video.",
            hint="Check the spelling, or drag the folder into the terminal to get its full name.",
        )
    if folder.is_dir():
        return
    if folder.suffix.lower() in LOSSY | LOSSLESS:
        hint = f"Name the folder instead: {folder.parent}"
    else:
        hint = "If it is an archive, unpack it and name the folder that comes out."
    raise SplatError(
        "ingest-not-a-folder",
        given=f"{folder} is a file.",
        wanted="A folder of photographs, or a video.",
        hint=hint,
    )


RAW_ADVICE = "Export raw files as JPEG or TIFF first, all with the same white balance and exposure."


def _no_photographs(folder: Path, found: Findings) -> SplatError:
    wanted = "JPEG, PNG, TIFF, WebP or HEIC photographs, at least 3; 20 to 50 do an object well."
    counts = {
        "raw file": len(found.raws),
        "picture": len(found.other_pictures),
        "other file": found.others,
    }
    if not any(counts.values()):
        return SplatError(
            "ingest-empty-folder",
            given=f"{folder} is empty.",
            wanted=wanted,
            hint="Copy the photographs into it, or name another folder.",
        )
    kinds = [counted(count, kind) for kind, count in counts.items() if count]
    hint = "Name the folder that holds the photographs."
    if found.raws:
        hint = RAW_ADVICE
    elif found.other_pictures:
        hint = "Save the pictures as JPEG or PNG first."
    return SplatError(
        "ingest-no-photographs",
        given=f"{folder} holds no photographs that can be read ({', '.join(kinds)}).",
        wanted=wanted,
        hint=hint,
    )
