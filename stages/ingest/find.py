"""Finds the photographs, videos and masks in a folder, by their names."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from stages.base.errors import ResourceError, SplatError
from stages.base.text import counted, printable_name
from stages.cameras import blender, nerfstudio
from stages.ingest import depth_files, masks
from stages.ingest.sources import (
    OTHER_PICTURES,
    PICTURES,
    RAW,
    RAW_ADVICE,
    VIDEO,
    DepthFile,
    Findings,
    Source,
    natural_key,
    picture_names,
    stem_of,
    suffix_of,
)
from stages.scene.capture import PHOTOS_FOLDER

_FRAME = re.compile(r"(^|/)frame_[0-9]+\.json$")  # of 3D Scanner App
_SMALL_COPY = re.compile(r"(^|/)thumb_[0-9]+\.jpg$")  # of a frame, in every scan of 3D Scanner App


def find(folder: Path, more_masks: Path | None = None, depth: Path | None = None) -> Findings:
    """Search `folder` and its sub-folders, without hidden files and folders.

    Links to folders are not followed, because they may form a loop.

    Args:
        folder: or a video, which counts as a folder that holds it.
        more_masks: a folder of masks besides those in `folder`.
        depth: a folder of depth maps, or a transforms.json, besides those in `folder`.

    Raises:
        SplatError: the folder is missing, is another file, cannot be listed or holds no photograph
            or video.
    """
    if folder.is_file() and folder.suffix.lower() in VIDEO:
        name = printable_name(folder.name)
        return Findings((), (Source(folder, name, f"{PHOTOS_FOLDER}{name}"),), (), (), 0)
    _check_folder(folder)
    files = _files_by_name(folder)
    depths, stray_depths, unused_depths = _remove_depths(files, folder, depth)
    mask_of, stray = _remove_masks(files, folder, more_masks)
    names = sorted(files, key=natural_key)
    pictures = [name for name in names if suffix_of(name) in PICTURES]
    in_scans = _without_pictures_of_scans(files, pictures)
    not_in_scans = (name for name in pictures if name not in set(in_scans))
    beside_frames = tuple(name for name in not_in_scans if not _SMALL_COPY.search(name))
    photographs = _posed(folder, in_scans)
    stems = {stem_of(name) for name in photographs}
    unpaired = [name for name in names if stem_of(name) not in stems]
    kinds = {
        kind: tuple(name for name in unpaired if suffix_of(name) in suffixes)
        for kind, suffixes in (("video", VIDEO), ("raw", RAW), ("other", OTHER_PICTURES))
    }
    images = picture_names([*photographs, *kinds["video"]])
    findings = Findings(
        sources=tuple(Source(files[name], name, images[name]) for name in photographs),
        videos=tuple(Source(files[name], name, images[name]) for name in kinds["video"]),
        raws=kinds["raw"],
        other_pictures=kinds["other"],
        others=len(names) - sum(map(len, (photographs, beside_frames, *kinds.values()))),
        not_files=_not_files(folder),
        masks=mask_of,
        stray_masks=stray,
        depths=depths,
        stray_depths=stray_depths,
        unused_depths=unused_depths,
        beside_frames=beside_frames,
    )
    if not findings.sources and not findings.videos:
        raise _no_photographs(folder, findings)
    return findings


def _posed(folder: Path, pictures: list[str]) -> list[str]:
    """The pictures that the camera files of a synthetic NeRF scene name; other pictures beside them
    are maps of depth and normals. All pictures where the folder is no such scene."""
    named: set[str] = set()
    if blender.locate(folder) is not None:
        with suppress(SplatError):
            named = {stem_of(view.name) for view in blender.read(folder).views}
    return [name for name in pictures if stem_of(name) in named] or pictures


def _without_pictures_of_scans(files: Iterable[str], pictures: list[str]) -> list[str]:
    """The pictures without the two that 3D Scanner App puts beside its frames: a small copy of one
    frame, and the texture of the mesh. In such a folder each frame has its frame_*.json."""
    frames = {name.rpartition(".")[0] for name in files if _FRAME.search(name)}
    of_frames = (name for name in pictures if name.rpartition(".")[0] in frames)
    scans = {name.rpartition("/")[0] for name in of_frames}
    return [
        name
        for name in pictures
        if name.rpartition("/")[0] not in scans or name.rpartition(".")[0] in frames
    ]


def _remove_masks(
    files: dict[str, Path], folder: Path, apart: Path | None
) -> tuple[dict[str, Path], tuple[str, ...]]:
    """Remove masks from `files`: in a folder called masks, in `apart` if it is inside, and beside
    their photographs. Returns masks by the photograph's name, and stray masks."""
    apart, photos = apart.resolve() if apart is not None else None, folder.resolve()
    inside = {
        name: name.partition("/")[2]
        for name in files
        if name.casefold().startswith(f"{masks.FOLDER}/")
    }
    if len(inside) == len(files):
        inside = {}  # a folder of nothing but masks holds photographs
    apart_masks = {short: files.pop(name) for name, short in inside.items()}
    if apart is not None and apart.is_dir() and apart != photos:
        every = _files_by_name(apart)
        if photos.is_relative_to(apart):  # masks lie above the photographs, not among them
            every = {n: p for n, p in every.items() if not p.resolve().is_relative_to(photos)}
        else:
            inside_it = [n for n, p in files.items() if p.resolve().is_relative_to(apart)]
            for name in inside_it:
                del files[name]
        apart_masks |= every
    apart_masks = {
        name: path for name, path in apart_masks.items() if suffix_of(name) in masks.MASK_SUFFIXES
    }
    pictures = [name for name in files if suffix_of(name) in PICTURES]
    beside = masks.masks_beside(pictures)
    paired = masks.pair_masks((name for name in pictures if name not in beside), apart_masks)
    for mask, photograph in beside.items():
        paired.setdefault(photograph, files.pop(mask))
    used = set(paired.values())
    stray = (name for name, path in apart_masks.items() if path not in used)
    return paired, tuple(sorted(stray, key=natural_key))


def _name_in(folder: Path, path: Path) -> str:
    """The name of a file relative to `folder`; "" if it lies elsewhere."""
    path, folder = path.resolve(), folder.resolve()
    return path.relative_to(folder).as_posix() if path.is_relative_to(folder) else ""


def _remove_depths(
    files: dict[str, Path], folder: Path, source: Path | None
) -> tuple[dict[str, DepthFile], tuple[str, ...], tuple[str, ...]]:
    """Remove maps of depth and of confidence from `files`, if any map belongs to a photograph. Maps
    are in a folder called depth, beside frames of 3D Scanner App, and in `source`, which may be the
    photographs' folder. Returns maps by the photograph's name, stray ones, and maps beside their
    photographs that `source` does not name, which are removed too."""
    maps: dict[str, Path] = {}
    among = source is not None and source.resolve() == folder.resolve()
    unit = 0.0
    if source is not None and source.is_file():
        named, unit = nerfstudio.depth_maps(source)
        maps = {_name_in(folder, source.parent / name) or name: at for name, at in named.items()}
    elif source is not None and source.is_dir() and not among:
        every = _files_by_name(source).items()
        maps = {name: path for name, path in every if suffix_of(name) in depth_files.SUFFIXES}
    apart = {path.resolve() for path in maps.values()}
    inside = {name for name in files if depth_files.is_map(name)}
    inside |= {name for name, path in files.items() if apart and path.resolve() in apart}
    for name in sorted(inside):
        if files[name].resolve() not in apart:
            short = name.partition("/")[2] if name.casefold().startswith("depth") else name
            maps[short or name] = files[name]
    beside = depth_files.maps_beside({n: at for n, at in files.items() if n not in inside}, among)
    if among:
        maps |= {name: files[name] for name in beside}
        inside |= beside
    unused = () if among else tuple(sorted(beside, key=natural_key))
    for name in unused:
        del files[name]
    pictures = [name for name in files if suffix_of(name) in PICTURES and name not in inside]
    paired = depth_files.pair_depths(pictures, maps, unit)
    if not paired:
        return {}, (), unused
    for name in [name for name in files if name in inside or depth_files.is_confidence(name)]:
        del files[name]
    used = {path for file in paired.values() for path in (file.path, *file.others)}
    stray = (
        name
        for name, path in maps.items()
        if path not in used and not depth_files.needs_no_photograph(name, files)
    )
    return paired, tuple(sorted(stray, key=natural_key)), unused


def _files_by_name(folder: Path) -> dict[str, Path]:
    """The files of a folder and its sub-folders by their names relative to it."""
    return {printable_name(path.relative_to(folder).as_posix()): path for path in _walk(folder)}


def _walk(folder: Path) -> Iterable[Path]:
    def refuse(error: OSError) -> None:
        raise ResourceError(
            "ingest-folder-unreadable",
            given=f"{error.filename} cannot be listed: {error.strerror}.",
            wanted="A folder that may be read, with all its sub-folders.",
            hint="Change its permissions, or move the photographs elsewhere.",
        ) from error

    for place, folders, files in os.walk(folder, onerror=refuse):
        folders[:] = [name for name in folders if not _is_hidden(name)]
        for name in files:
            path = Path(place, name)
            if not name.startswith(".") and path.is_file():
                yield path


def _not_files(folder: Path) -> dict[str, str]:
    """See `Findings.not_files`."""
    reasons = {}
    for place, folders, files in os.walk(folder):
        folders[:] = [name for name in folders if not _is_hidden(name)]
        for path in (Path(place, name) for name in (*folders, *files) if not _is_hidden(name)):
            why = ""
            if path.is_dir():
                why = "it is a link to a folder, which is not followed" if path.is_symlink() else ""
            elif not path.is_file():
                why = "it is a broken link" if path.is_symlink() else "it is a pipe or a device"
            if why:
                reasons[printable_name(path.relative_to(folder).as_posix())] = why
    return reasons


def _is_hidden(name: str) -> bool:
    return name.startswith(".") or name == "__MACOSX"


def _check_folder(folder: Path) -> None:
    if folder.is_dir():
        return
    if folder.suffix.lower() in PICTURES:
        hint = f"Name the folder instead: {folder.parent}"
    else:
        hint = "If it is an archive, unpack it and name the folder that comes out."
    raise SplatError(
        "ingest-not-a-folder",
        given=f"{folder} is a file.",
        wanted="A folder of photographs, or a video.",
        hint=hint,
    )


def _no_photographs(folder: Path, findings: Findings) -> SplatError:
    wanted = "JPEG, PNG, TIFF, WebP or HEIC photographs, at least 3; 20 to 50 do an object well."
    counts = {
        "raw file": len(findings.raws),
        "picture": len(findings.other_pictures),
        "other file": findings.others,
        "link, pipe or device": len(findings.not_files),
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
    if findings.raws:
        hint = RAW_ADVICE
    elif findings.other_pictures:
        hint = "Save the pictures as JPEG or PNG first."
    return SplatError(
        "ingest-no-photographs",
        given=f"{folder} holds no photographs that can be read ({', '.join(kinds)}).",
        wanted=wanted,
        hint=hint,
    )
