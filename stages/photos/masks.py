"""Which masks belong to which photographs, by their names."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

from stages.base.errors import SplatError

if TYPE_CHECKING:
    from stages.photos.find import Findings

FOLDER = "masks"  # beside the photographs' folder, or in it
MASK_SUFFIXES = frozenset({".png", ".tif", ".tiff", ".bmp", ".jpg", ".jpeg", ".webp"})


def mask_folder(photos: Path, chosen: Path | None) -> Path | None:
    """Where masks lie besides the photographs' own folder: as chosen, or beside it."""
    beside = photos.absolute().parent / FOLDER
    return chosen or (beside if beside.is_dir() and beside != photos.absolute() else None)


def check_pairing(found: Findings, apart: Path | None, chosen: Path | None) -> None:
    """apart: the folder of masks that was looked into, `chosen` or only found beside.

    Raises SplatError: "masks-missing" where the folder chosen holds none, "masks-of-others" where
    masks belong to no photograph by their names.
    """
    if found.masks or (chosen is None and (apart is not None or not found.stray_masks)):
        return
    if chosen is not None and not found.stray_masks:
        raise SplatError(
            "masks-missing",
            given=f"{chosen} holds no masks of photographs.",
            wanted="A folder of grey pictures, named as the photographs are.",
            hint="Check the path.",
        )
    photograph, mask = (found.sources or found.videos)[0].name, found.stray_masks[0]
    stem = PurePosixPath(photograph).stem
    raise SplatError(
        "masks-of-others",
        given=f"No mask belongs to a photograph by its name: {mask}, say, and {photograph}.",
        wanted=f"For {photograph}: {stem}.png, {photograph}.png or {stem}_mask.png.",
        hint="Masks of another capture? Name their folder with --masks, or take them away.",
    )


def names_for(photograph: str) -> tuple[str, ...]:
    """What the mask of a photograph ("day 1/a.jpg") may be called, without its own ending: by
    COLMAP (a.jpg.png), nerfstudio (a.png), Metashape (a_mask.png). Folded."""
    stem = str(PurePosixPath(photograph).with_suffix(""))
    return photograph.casefold(), stem.casefold(), f"{stem}_mask".casefold()


def paired(photographs: Iterable[str], masks: Mapping[str, Path]) -> dict[str, Path]:
    """The mask of each photograph that has one, by the photograph's name.

    masks: by name relative to their folder. A folder without the photographs' sub-folders will do
    where names are not used twice.
    """
    photographs = list(photographs)
    by_stem = {_stem(name): path for name, path in sorted(masks.items())}
    found = {}
    for name in photographs:
        match = next((by_stem[key] for key in names_for(name) if key in by_stem), None)
        if match is not None:
            found[name] = match
    bare = [PurePosixPath(name).name for name in photographs]
    if not found and len({name.casefold() for name in bare}) == len(bare):
        short = {PurePosixPath(name).name: path for name, path in sorted(masks.items())}
        if short != dict(masks) or bare != photographs:
            again = paired(bare, short)
            found = {
                name: again[last]
                for name, last in zip(photographs, bare, strict=True)
                if last in again
            }
    return found


def beside(photographs: Iterable[str]) -> dict[str, str]:
    """Of files in one folder, those that are masks of others there (a.jpg.png, a_mask.png beside
    a.jpg): the photograph's name by the mask's."""
    photographs = list(photographs)
    by_key = {}
    for name in photographs:
        whole, _, marked = names_for(name)
        by_key[whole] = by_key[marked] = name
    return {name: by_key[_stem(name)] for name in photographs if _stem(name) in by_key}


def _stem(name: str) -> str:
    return str(PurePosixPath(name).with_suffix("")).casefold()
