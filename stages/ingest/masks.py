"""Pairs masks with photographs by their names."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path, PurePosixPath

from stages.base.errors import SplatError
from stages.ingest.sources import Findings, folder_beside

FOLDER = "masks"  # beside the photographs' folder, or in it
MASK_SUFFIXES = frozenset({".png", ".tif", ".tiff", ".bmp", ".jpg", ".jpeg", ".webp"})


def mask_folder(photos: Path, chosen: Path | None) -> Path | None:
    """The folder of masks outside the photographs' folder: the one that was chosen, or one called
    masks beside it."""
    return chosen or folder_beside(photos, (FOLDER,))


def check_rig_mask(file: Path | None) -> None:
    """Raises SplatError "file-missing" if the mask for all panoramas is no file. Checked at once,
    because it is opened only when there is a panorama."""
    if file is not None and not file.is_file():
        raise SplatError(
            "file-missing",
            given=f"--rig-mask {file} {'is a folder' if file.is_dir() else 'does not exist'}.",
            wanted="A picture twice as wide as high, black where all panoramas show the stand.",
            hint="Check the path; masks of single photographs are given with --masks.",
        )


def check_pairing(files: Findings, apart: Path | None, chosen: Path | None) -> None:
    """Check that masks which were given belong to photographs.

    Args:
        files: what the capture's folder holds.
        apart: the folder of masks that was searched: `chosen`, or one found beside.
        chosen: the folder that was given as a setting.

    Raises:
        SplatError: "ingest-video-alone" if there are videos alone, "masks-missing" if `chosen`
            holds none, "masks-of-others" if no mask belongs to a photograph by its name.
    """
    if files.masks or (chosen is None and (apart is not None or not files.stray_masks)):
        return
    if files.videos and not files.sources:
        raise of_video("masks", files)
    if chosen is not None and not files.stray_masks:
        raise SplatError(
            "masks-missing",
            given=f"{chosen} holds no masks of photographs.",
            wanted="A folder of grey pictures, named as the photographs are.",
            hint="Check the path.",
        )
    photograph, mask = (files.sources or files.videos)[0].name, files.stray_masks[0]
    stem = PurePosixPath(photograph).stem
    raise SplatError(
        "masks-of-others",
        given=f"No mask belongs to a photograph by its name: {mask}, say, and {photograph}.",
        wanted=f"For {photograph}: {stem}.png, {photograph}.png or {stem}_mask.png.",
        hint="If they are masks of another capture, remove them, or name a folder with --masks.",
    )


def of_video(what: str, files: Findings) -> SplatError:
    """The error for masks, or other files of photographs, that were given for videos alone. what:
    they are."""
    video = files.videos[0]
    return SplatError(
        "ingest-video-alone",
        given=f"There are {what}, and of photographs only videos ({video.name}).",
        wanted=f"Photographs of the {what}: frames of a video have none before they are taken.",
        hint=f"Leave the {what} away. To use them, copy the frames that this makes "
        f"(1-ingest/{video.image}) into a folder of their own, and process it with {what} that "
        "have the names of the frames.",
    )


def names_for(photograph: str, ending: str = "_mask") -> tuple[str, ...]:
    """Names that the mask of a photograph ("day 1/a.jpg") may have, without its own suffix: those
    of COLMAP (a.jpg.png), nerfstudio (a.png) and Metashape (a_mask.png)."""
    stem = _stem(photograph)
    return photograph, stem, f"{stem}{ending}"


def _stem(name: str) -> str:
    return str(PurePosixPath(name).with_suffix(""))


def pair_masks(
    photographs: Iterable[str], masks: Mapping[str, Path], ending: str = "_mask"
) -> dict[str, Path]:
    """The mask of each photograph that has one, by the photograph's name. A name counts in its own
    case before any other: x.jpg.png is for x.jpg, not for X.JPG beside it.

    The folder of masks need not have the photographs' sub-folders if no name is used twice.

    Args:
        photographs: names relative to their folder.
        masks: by name relative to theirs.
        ending: see `names_for`.
    """
    photographs = list(photographs)
    mask_of: dict[str, Path] = {}
    for fold in (str, str.casefold):
        used = set(mask_of.values())
        left = {name: path for name, path in sorted(masks.items()) if path not in used}
        by_stem = {fold(_stem(name)): path for name, path in left.items()}
        for name in photographs:
            keys = [key for key in map(fold, names_for(name, ending)) if key in by_stem]
            if keys and name not in mask_of:
                mask_of[name] = by_stem[keys[0]]
    bare = [PurePosixPath(name).name for name in photographs]
    if not mask_of and len({name.casefold() for name in bare}) == len(bare):
        short = {PurePosixPath(name).name: path for name, path in sorted(masks.items())}
        if short != dict(masks) or bare != photographs:
            again = pair_masks(bare, short, ending)
            mask_of = {
                name: again[last]
                for name, last in zip(photographs, bare, strict=True)
                if last in again
            }
    return mask_of


def masks_beside(photographs: Iterable[str], ending: str = "_mask") -> dict[str, str]:
    """Files of a folder that are masks of others there (a.jpg.png or a_mask.png beside a.jpg): the
    photograph's name by the mask's. ending: see `names_for`."""
    photographs = list(photographs)
    photograph_of: dict[str, str] = {}
    for fold in (str.casefold, str):  # the second is closer
        keys = {fold(key): name for name in photographs for key in names_for(name, ending)[::2]}
        photograph_of |= {n: keys[fold(_stem(n))] for n in photographs if fold(_stem(n)) in keys}
    return photograph_of
