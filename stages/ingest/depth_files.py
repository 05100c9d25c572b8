"""Measured depth beside photographs: which file belongs to which photograph, and what it holds.

Read are 16-bit PNG and TIFF (millimetres), and TIFF, EXR and .npy of floating-point numbers
(metres): the depth along the camera's axis (z). 0, NaN and the largest number of 16 bits mean that
nothing was measured. A transforms.json of nerfstudio's names a map for each photograph, and the
metres of one step of their values. Apps of phones write their confidence in three levels; only the
highest is used.
"""

from __future__ import annotations

import io
import os
import re
from collections.abc import Container, Iterable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from stages.base.errors import SplatError
from stages.cameras import nerfstudio
from stages.cameras.nerfstudio import MILLIMETRE
from stages.ingest.decode import Decoded, Unusable, check_size, readers_set_up
from stages.ingest.masking import turned_with
from stages.ingest.masks import masks_beside, names_for, of_video, pair_masks
from stages.ingest.sources import (
    PICTURES,
    DepthFile,
    Findings,
    folder_beside,
    stem_of,
    suffix_of,
)
from stages.scene import fitted_size

FOLDERS = ("depth", "depths")  # beside the photographs' folder, or in it
CONFIDENCE = "confidence"  # a folder beside that of the maps
SUFFIXES = frozenset({".png", ".tif", ".tiff", ".exr", ".npy"})
_ENDING = "_depth"  # of the names of maps
LARGEST = 0xFFFF  # what depth sensors write where they measured nothing, if not 0
MAX_SIDE = 320  # of a map that is kept, pixels: seeds are no denser
_MOST_BYTES = 1 << 30
_EXPORT = "Export it as 16-bit PNG in millimetres, or as TIFF, EXR or .npy in metres"
_SCANNER_APP = re.compile(r"(^|/)depth(_[0-9]+\.)")  # depth_00012.png is of frame_00012.jpg
# The header of an EXR whose one channel has a name of one letter, such as Record3D's "R". FFmpeg
# reads one channel only if it is called "Y".
_ONE_CHANNEL = re.compile(rb"(channels\0chlist\0\x13\0\0\0)[A-Za-z]\0")
_CONFIDENCE = re.compile(r"(^|/)conf_[0-9]+\.")


def depth_source(photos: Path, chosen: Path | None) -> Path | None:
    """What holds the depth maps outside the photographs' folder: the folder or transforms.json that
    was chosen, or a folder called depth beside the photographs'."""
    return chosen or folder_beside(photos, FOLDERS)


def files_of(source: Path) -> list[Path]:
    """The files and folders of maps and of their confidence. Raises SplatError."""
    if not source.is_file():
        return [path for path in (source, source.with_name(CONFIDENCE)) if path.is_dir()]
    return [source, *nerfstudio.depth_maps(source)[0].values()]


def folder_of(file: Path, source: Path) -> str:
    """What tells a file or folder of `files_of(source)` from others of the same name: the start of
    the names of its files, "" or one with a slash at its end."""
    if file.name == CONFIDENCE and file != source:
        return f"{CONFIDENCE}/"
    if not source.is_file():
        return ""
    folder = Path(os.path.relpath(file.parent, source.parent)).as_posix()
    return "" if folder == "." else f"{folder}/"


def pair_depths(
    photographs: Iterable[str], maps: Mapping[str, Path], unit: float = 0.0
) -> dict[str, DepthFile]:
    """The depth map of each photograph that has one, paired as masks are: a.png, a.jpg.png or
    a_depth.png for a.jpg, and depth_1.png for frame_1.jpg.

    Args:
        photographs: names relative to their folder.
        maps: files by name relative to theirs.
        unit: see `DepthFile`.
    """
    left = {_of_frame(name): path for name, path in maps.items()}
    maps_of: dict[str, DepthFile] = {}
    names = list(photographs)
    while more := pair_masks(names, left, _ENDING):
        for name, path in more.items():
            first = maps_of.get(name, DepthFile(path, unit))
            others = (*first.others, path) if name in maps_of else ()
            maps_of[name] = DepthFile(first.path, unit, others)
        used = set(more.values())
        left = {name: path for name, path in left.items() if path not in used}
    return maps_of


def maps_beside(files: Mapping[str, Path], chosen: bool) -> set[str]:
    """Names of the depth maps beside their photographs: a_depth.png beside a.jpg.

    Args:
        files: of the photographs' folder, by name.
        chosen: whether the user says that maps are there. Then the other names of maps count, too
            (a.jpg.png, a.png, a.npy), unless the file is a picture of 8 bits or in colour, such as
            a mask. Otherwise such a picture is a photograph even if it is called a_depth.png.
    """
    pictures = [name for name in files if suffix_of(name) in PICTURES]
    found = {
        name
        for name in masks_beside(pictures, _ENDING)
        if suffix_of(name) in SUFFIXES and stem_of(name).endswith(_ENDING)
    }
    if not chosen:
        return {name for name in found if _measures(files[name])}
    left = [name for name in pictures if name not in found]
    measured = {name for name in left if suffix_of(name) in SUFFIXES and _measures(files[name])}
    photographs = {name for name in left if name not in measured} or set(left)
    stems = {key.casefold() for name in photographs for key in names_for(name, _ENDING)}
    others = (n for n in files if suffix_of(n) in SUFFIXES and n not in photographs)
    return found | {name for name in others if stem_of(name) in stems}


def _measures(path: Path) -> bool:
    """Whether a PNG or a TIFF is grey, of more than 8 bits. Only its head is read."""
    try:
        with readers_set_up(), Image.open(path, formats=("PNG", "TIFF")) as image:
            return image.mode[0] in "IF"
    except Exception:  # decoders raise whatever the damage leads to
        return False


def needs_no_photograph(name: str, files: Container[str]) -> bool:
    """Whether a map in the photographs' folder belongs to a frame of 3D Scanner App: then `files`
    holds the frame's .json. The app writes pictures for some of its frames only."""
    return f"{_of_frame(name).rpartition('.')[0]}.json" in files


def _of_frame(name: str) -> str:
    return _SCANNER_APP.sub(r"\1frame\2", name)


def is_map(name: str) -> bool:
    """Whether a file in the photographs' folder may be a depth map, by its name."""
    marked = name.casefold().startswith(tuple(f"{folder}/" for folder in FOLDERS))
    return suffix_of(name) in SUFFIXES and (marked or bool(_SCANNER_APP.search(name)))


def is_confidence(name: str) -> bool:
    """Whether a file in the photographs' folder may say how confident a map is."""
    return name.casefold().startswith(f"{CONFIDENCE}/") or bool(_CONFIDENCE.search(name))


def confidence_of(path: Path) -> Path | None:
    """The file that says how confident a map is, if there is one."""
    beside = path.with_name(path.name.replace("depth_", "conf_", 1))
    candidates = (path.parent.with_name(CONFIDENCE) / path.name, beside)
    return next((file for file in candidates if file != path and file.is_file()), None)


def check_paired(files: Findings, chosen: Path | None) -> None:
    """Raises SplatError "depth-missing" if nothing in `chosen` is the map of a photograph, and
    "ingest-video-alone"."""
    if chosen is not None and not files.depths:
        if not files.sources:
            raise of_video("depth maps", files)
        photograph = files.sources[0].name
        raise SplatError(
            "depth-missing",
            given=f"{chosen} holds no depth map of a photograph such as {photograph}.",
            wanted=f"Files named as the photographs are ({', '.join(sorted(SUFFIXES))}), or a "
            "transforms.json with depth_file_path.",
            hint="Check the path, or leave --depth away: depth is not required.",
        )


def read_depth(file: DepthFile, decoded: Decoded, as_stored: bool = False) -> NDArray[np.float32]:
    """[h, w] metres, 0 where nothing was measured; upright, its longer side at most MAX_SIDE.

    decoded: the photograph. as_stored: see `turned_with`. Raises Unusable.
    """
    if file.others:
        names = ", ".join(path.name for path in (file.path, *file.others))
        raise Unusable(f"there are {1 + len(file.others)} for it ({names})", "Keep one of them")
    try:
        values = _values(file.path)
        confidence = confidence_of(file.path)
        sure = None if confidence is None else _values(confidence)
    except Unusable:
        raise
    except FileNotFoundError as error:
        raise Unusable(f"{file.path.name} does not exist", "Put it back") from error
    except Exception as error:  # decoders raise whatever the damage leads to
        raise Unusable(f"{file.path.name} does not decode", _EXPORT) from error
    if values.ndim != 2 or values.dtype.kind not in "uif" or values.dtype.itemsize == 1:
        raise Unusable(f"{file.path.name} is a picture of 8 bits or in colour", _EXPORT)
    whole = values.dtype.kind != "f"
    with np.errstate(over="ignore", invalid="ignore"):
        metres = values.astype(np.float32) * np.float32(file.unit or (MILLIMETRE if whole else 1))
        known = np.isfinite(metres) & (metres > 0)
        if whole:
            known &= values != LARGEST
        metres = np.where(known, metres, np.float32(0))
    if sure is not None and sure.shape == metres.shape:
        highest = 2 if sure.max() <= 2 else 255
        metres = np.where(sure >= highest, metres, np.float32(0))
    if not metres.any():
        raise Unusable(f"{file.path.name} holds no confident measurement", _EXPORT)
    metres = _upright(metres, decoded, as_stored, file.path.name)
    size = fitted_size(metres.shape[1], metres.shape[0], MAX_SIDE)
    return np.asarray(cv2.resize(metres, size, interpolation=cv2.INTER_NEAREST_EXACT))


def _upright(
    metres: NDArray[np.float32], decoded: Decoded, as_stored: bool, name: str
) -> NDArray[np.float32]:
    """Turned with the photograph, see `turned_with`. Raises Unusable."""
    turned, sizes = turned_with(Image.fromarray(metres), decoded, as_stored)
    if sizes:
        raise Unusable(f"{name} is {sizes}", "Use a map with its photograph's proportions")
    return np.asarray(turned)


def size_of(path: Path) -> tuple[int, int] | None:
    """(width, height) of a map; None if it cannot be read."""
    try:
        if path.suffix.lower() in (".npy", ".exr"):
            height, width = _values(path).shape[:2]
            return width, height
        with Image.open(path, formats=("PNG", "TIFF")) as image:
            return image.size
    except Exception:  # decoders raise whatever the damage leads to
        return None


def _values(path: Path) -> NDArray[Any]:
    """The values of a file as they are stored. Raises what decoders raise, and Unusable."""
    if path.stat().st_size > _MOST_BYTES:
        raise Unusable(f"{path.name} is larger than 1 GiB", _EXPORT)
    if path.suffix.lower() == ".npy":
        values = np.load(path, mmap_mode="r", allow_pickle=False)
        values = values[..., 0] if values.ndim == 3 and values.shape[2] == 1 else values
        check_size(values.shape[1::-1])
        return np.asarray(values)
    if path.suffix.lower() == ".exr":
        return _exr(path)
    with Image.open(path, formats=("PNG", "TIFF")) as image:
        check_size(image.size)
        return np.asarray(image)


def _exr(path: Path) -> NDArray[np.float32]:
    """The only channel, or red; as 16 or 32 bits."""
    import av

    data = _ONE_CHANNEL.sub(rb"\1Y\0", path.read_bytes(), count=1)
    with av.open(io.BytesIO(data), "r", format="exr_pipe") as opened:
        codec = opened.streams.video[0].codec_context
        if not codec.width:  # FFmpeg knows no such file
            raise Unusable(f"{path.name} does not decode", _EXPORT)
        check_size((codec.width, codec.height))
        frame = next(opened.decode(video=0))
    name = frame.format.name  # PyAV converts not all of them
    number = np.dtype(("<", ">")[name.endswith("be")] + ("f4", "f2")["f16" in name])
    plane = frame.planes[0 if name.startswith("grayf") else 2]  # green, blue, red
    values = np.frombuffer(bytes(plane), number).reshape(frame.height, -1)
    return np.asarray(values[:, : frame.width], np.float32)
