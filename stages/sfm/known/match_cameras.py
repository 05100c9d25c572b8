"""Assigns the cameras of a file to photographs by name, as far as other programs keep names."""

from __future__ import annotations

import unicodedata
from collections import defaultdict
from collections.abc import Sequence
from pathlib import PurePosixPath

from stages.base.errors import SplatError, UsageError
from stages.base.stage import Report
from stages.base.text import counted, listed
from stages.cameras.camera_file import CameraFile
from stages.ingest.sources import LOSSLESS, LOSSY, OTHER_PICTURES, RAW
from stages.scene import Camera, Capture, Photo, View
from stages.sfm.undistorted_images import PosedPhoto

_SUFFIXES = LOSSY | LOSSLESS | RAW | OTHER_PICTURES
_FEWEST = 3  # photographs
_SHAPE_TOLERANCE = 0.01
_PARTIAL = "--allow-partial goes on with those that match."


def match_cameras(
    found: CameraFile, capture: Capture, split: bool, allow_partial: bool, report: Report
) -> list[PosedPhoto]:
    """The photographs that have a camera, in the capture's order.

    Args:
        found: the cameras.
        capture: the photographs.
        split: keep the file's train and test photographs with these roles, and leave out others.
        allow_partial: leave out cameras without photograph and photographs without camera.
        report: receives a warning about these.

    Raises SplatError, without `allow_partial` also if a camera has no photograph or a photograph no
    camera. With `split`, a photograph that the split leaves out (a benchmark's depth map, for
    example) needs no camera.
    """
    check_split(found, split)
    wanted = [i for i, v in enumerate(found.views) if not split or v.role in ("train", "test")]
    views = [found.views[i] for i in wanted]
    matches, missing = _matched(views, capture.photos)
    without = [p.name for i, p in enumerate(capture.photos) if i not in matches.values()]
    if split and not missing:
        without = []
    _check_missing(missing, without, len(matches), allow_partial, report)
    posed = []
    for number, position in sorted(matches.items(), key=lambda match: match[1]):
        view, photo = views[number], capture.photos[position]
        lens = found.lenses[wanted[number]]
        posed.append(PosedPhoto(photo, _scaled(view, photo), lens, view.role if split else ""))
    return posed


def _matched(views: Sequence[View], photos: Sequence[Photo]) -> tuple[dict[int, int], list[str]]:
    """(photograph by view, names of views without one). Names are compared from the end: the more
    folders are equal the better; suffixes may differ or be missing."""
    by_stem: dict[str, list[int]] = defaultdict(list)
    for position, photo in enumerate(photos):
        for name in {photo.name, photo.picture}:
            by_stem[name_parts(name)[0]].append(position)
    matches: dict[int, int] = {}
    missing: list[str] = []
    owner: dict[int, str] = {}
    for number, view in enumerate(views):
        candidates = set(by_stem.get(name_parts(view.name)[0], ()))
        scores = {i: _agreement(view.name, photos[i]) for i in candidates}
        best = [i for i in sorted(scores) if scores[i] == max(scores.values())]
        if not best:
            missing.append(view.name)
        elif len(best) > 1:
            raise _ambiguous(view.name, [photos[i].name for i in best])
        elif best[0] in owner:
            raise _twice(owner[best[0]], view.name, photos[best[0]].name)
        else:
            matches[number] = best[0]
            owner[best[0]] = view.name
    return matches, missing


def name_parts(name: str) -> list[str]:
    """The name without its suffix, then its folders, innermost first; case-folded."""
    normalised = unicodedata.normalize("NFC", name.replace("\\", "/")).casefold()
    path = PurePosixPath(normalised)
    stem = path.stem if path.suffix in _SUFFIXES else path.name
    return [stem, *reversed([part for part in path.parent.parts if part not in (".", "..")])]


def _suffix(name: str) -> str:
    return PurePosixPath(name).suffix.casefold()


def _agreement(name: str, photo: Photo) -> tuple[int, bool, bool]:
    """How well names agree, larger is better: (folders in common, same suffix, no more folders)."""
    mine, theirs = name_parts(name)[1:], name_parts(photo.name)[1:]
    common = 0
    for a, b in zip(mine, theirs, strict=False):
        if a != b:
            break
        common += 1
    return common, _suffix(name) == _suffix(photo.name), len(theirs) == common


def _scaled(view: View, photo: Photo) -> Camera:
    """The camera in pixels of the photograph, which ingest may have made smaller."""
    camera = view.camera
    shape = camera.width * photo.height / (camera.height * photo.width)
    rounding = 1.0 / min(photo.width, photo.height)
    if abs(shape - 1.0) <= _SHAPE_TOLERANCE + rounding:
        return camera.resized(photo.width, photo.height)
    swapped = abs(camera.height * photo.height / (camera.width * photo.width) - 1.0) < 0.02
    raise SplatError(
        "cameras-other-shape",
        given=f"The camera of {photo.name} is for pictures of {camera.width} x {camera.height}, "
        f"the photograph has {photo.width} x {photo.height}.",
        wanted="Cameras of these photographs, with the same aspect ratio.",
        hint="The photograph is rotated by its EXIF orientation, and the camera is for the pixels "
        "before that: rotate the pixels themselves, and estimate the cameras again."
        if swapped
        else "Give the photographs that the cameras were estimated from, uncropped.",
    )


def _check_missing(
    missing: list[str], without: list[str], matched: int, allow_partial: bool, report: Report
) -> None:
    problems = []
    if missing:
        problems.append(
            f"{counted(len(missing), 'camera')} of the file "
            f"{'names' if len(missing) == 1 else 'name'} photographs that are not there "
            f"({listed(missing)})"
        )
    if without:
        has = "has" if len(without) == 1 else "have"
        problems.append(
            f"{counted(len(without), 'photograph')} {has} no camera in the file ({listed(without)})"
        )
    if not problems:
        return
    given = "; ".join(problems) + "."
    code = "cameras-without-photographs" if missing else "cameras-missing"
    if matched < _FEWEST or not allow_partial:
        raise SplatError(
            code,
            given=given if matched else f"No photograph has a camera in the file: {given}",
            wanted="A camera for every photograph and a photograph for every camera, by name.",
            hint="Give the folder of the photographs that the file names. " + _PARTIAL,
        )
    report.warn(code, f"{given} These are left out.")


def _ambiguous(name: str, photos: list[str]) -> SplatError:
    return SplatError(
        "cameras-ambiguous",
        given=f"The camera of {name[:80]} may belong to any of {listed(photos)}.",
        wanted="Names that identify one photograph each.",
        hint="Give a folder of photographs with only one of them.",
    )


def _twice(first: str, second: str, photo: str) -> SplatError:
    return SplatError(
        "cameras-of-one-name",
        given=f"Two cameras of the file, {first[:80]} and {second[:80]}, belong to {photo}.",
        wanted="One camera for each photograph.",
        hint="Remove one of them from the file.",
    )


def check_split(found: CameraFile, split: bool) -> None:
    """Raises SplatError "cameras-without-split" if a split is wanted that the file has not."""
    if split and not {view.role for view in found.views} >= {"train", "test"}:
        raise UsageError(
            "cameras-without-split",
            given="--split is given, but the camera file does not say which photographs are for "
            "training and which for testing.",
            wanted="transforms_train.json and transforms_test.json, a file with train_filenames "
            "and test_filenames, or a COLMAP model with the test photographs' names in test.txt.",
            hint="Leave --split away; then every eighth photograph is held out.",
        )
